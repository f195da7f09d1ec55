"""The worker in which frames live, its supervisor in the service, and what the views see."""
