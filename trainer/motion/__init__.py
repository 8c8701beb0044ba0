"""Motion of a region by an edit, found from its views: by whole parts, or bent by control points."""
