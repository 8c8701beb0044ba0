"""Pull tool: its handles, their transforms and their drawing."""
