"""Running stages as processes of their own: what the demo, the batch and the add-on share."""
