"""How do layers of edits add up?"""
