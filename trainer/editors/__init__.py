"""Image editors: views in, edited views out."""
