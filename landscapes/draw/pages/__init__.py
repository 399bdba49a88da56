"""Pages that need no network: their templates and scripts, and what they are filled with."""
