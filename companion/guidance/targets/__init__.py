"""What is seen as places in local NED: made from detections and markers, filtered, chosen."""
