"""What the window has done by child processes: training, pictures of an editor, films and exports."""
