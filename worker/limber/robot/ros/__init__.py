"""A bridge to ROS 2 that needs no ROS here: rosbridge's protocol over a websocket."""
