"""Plants and sensors that share no code with the project's own generator, for `scans`."""
