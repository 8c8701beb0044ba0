"""Application window: main view, tools, file actions, training, previews and exports."""
