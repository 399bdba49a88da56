"""Jobs that work in a folder, can be stopped and continued, report progress by callback, and print nothing."""
