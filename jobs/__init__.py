"""Work in a folder on disk that can be stopped and goes on: progress by callback, nothing printed."""
