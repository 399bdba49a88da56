"""The examination of `gs.check`: planted defects, healthy awkward functions, and what other checkers find of them."""
