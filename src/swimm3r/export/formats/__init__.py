"""One module per format, each with its `export_run(folder, path, settings)`."""
