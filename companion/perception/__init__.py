"""The worker in which frames live, its keeper in the service, and what the views see."""
