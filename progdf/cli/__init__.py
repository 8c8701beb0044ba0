"""Commands that need neither trainer nor viewer."""
