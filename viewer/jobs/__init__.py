"""Child processes of the window: training, previews of an editor, films and exports."""
