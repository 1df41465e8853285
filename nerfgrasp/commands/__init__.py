"""One file a subcommand, each a thin, typed function. Importing the package itself imports nothing."""
