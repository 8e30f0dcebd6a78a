"""ROS bags of version 1 and 2: their topics, images, lenses and poses."""
