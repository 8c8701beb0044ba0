"""How is it read and written, whole or not at all?"""
