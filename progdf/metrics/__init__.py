"""How far apart are two pictures, and how does a slider feel?"""
