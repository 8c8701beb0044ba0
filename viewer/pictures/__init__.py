"""Pictures made of pictures: comparisons, sheets, films, thumbnails."""
