"""`jaxfilters fit`: models and noise parameters estimated from recordings."""
