"""Arms that a URDF file describes: any chain of six or more revolute joints."""
