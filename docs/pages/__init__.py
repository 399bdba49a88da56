"""Pages that are written when the site is built, each from what it documents: a module for each kind of them."""
