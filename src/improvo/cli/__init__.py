"""The commands: read arguments, call one verb, print the result. One module per command, imported when it is called."""
