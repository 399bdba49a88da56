"""Run `landscape` as `python -m gradscape`."""

from gradscape.cli import main

if __name__ == "__main__":
    main()
