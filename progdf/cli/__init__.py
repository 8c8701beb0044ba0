"""Commands that depend on neither trainer nor viewer."""
