"""`jaxfilters calibrate`: intrinsic and extrinsic parameters of cameras."""
