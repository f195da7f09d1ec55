"""Events of objects and the vehicle's state for home automation and fleets: MQTT, webhooks."""


class MqttError(ValueError):
    """Something in the settings of MQTT or of webhooks cannot be used. The message is one line."""
