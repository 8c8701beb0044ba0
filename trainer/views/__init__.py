"""Views for training and measuring an edit."""
