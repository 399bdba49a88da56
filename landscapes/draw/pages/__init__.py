"""Pages that need no network: templates, scripts, and the functions that fill them."""
