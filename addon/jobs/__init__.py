"""Run the worker: its stages, as jobs that queue, show progress and can be cancelled."""
