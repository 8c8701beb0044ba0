"""Everything that owns a GL object."""
