"""Parts of the window: each performs the commands of one topic, with the collaborators that it receives."""
