"""Length and pose of an articulated hand from image features of one camera."""
