"""The commands: each module reads arguments, calls one function, and prints the result.

It imports every room but `backend`, `stability` and `tracking`, each when a command needs it. Open `commands.py` first:
the table of all commands with their modules. `main.py` reads the command line.
"""
