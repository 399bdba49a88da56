"""Pages that are generated when the site is built; each module writes one kind of page."""
