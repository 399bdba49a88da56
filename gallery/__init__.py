"""The paper's figures as data, and the static site built from them."""
