"""How an edit has moved a region, found from its views: parts as wholes, or bent by control points."""
