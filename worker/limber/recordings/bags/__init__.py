"""Recordings of robots as bags: MCAP files, rosbag2 folders and ROS 1 bags, in and out."""
