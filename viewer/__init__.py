"""The interactive viewer and its headless twin."""
