"""Work in a folder on disk that can be stopped and continues: progress by callback, nothing printed."""
