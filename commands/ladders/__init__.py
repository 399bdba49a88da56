"""What `landscape tradeoff --ladder` can measure: a module for each ladder, whose `run` measures, prints and keeps."""
