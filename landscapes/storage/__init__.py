"""A slice on disk: the zarr layout and its tiles, and the files and folders that appear whole or not at all."""
