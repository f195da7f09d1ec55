"""ROS 2: the bus as ROS messages, and ROS's requests and images for the service."""
