"""The companion-computer service: perception in, offboard setpoints out, detections on zenoh."""
