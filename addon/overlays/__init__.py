"""What is drawn upon the 3D view: marks, scans, legend and graph."""
