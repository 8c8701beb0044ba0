"""Editors whose pictures a server makes: OpenAI's images API and ComfyUI."""
