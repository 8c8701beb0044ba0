"""What is in a scene, and where?"""
