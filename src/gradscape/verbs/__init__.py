"""The verbs of the command `landscape`, one function each; nothing heavy is imported before it is used."""
