"""One user action a file: gather context, start a job or use the bridge, report."""
