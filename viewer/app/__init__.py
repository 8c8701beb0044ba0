"""Application window: main view, tools, dialogs, file actions and the studio."""
