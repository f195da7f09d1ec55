"""Targets in local NED: from detections and markers, filtered, selected."""
