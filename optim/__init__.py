"""Ask/tell optimisers and the race that compares them."""
