"""Files of pictures and maps."""
