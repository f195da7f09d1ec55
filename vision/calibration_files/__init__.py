"""Files of a calibration: those of ROS, Kalibr and OpenCV are read, one is written."""
