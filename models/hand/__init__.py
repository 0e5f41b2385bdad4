"""An articulated hand: skeleton, surface, depth likelihood."""
