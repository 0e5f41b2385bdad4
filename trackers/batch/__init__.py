"""`jaxfilters batch`: many recordings over processes and machines that share a folder."""
