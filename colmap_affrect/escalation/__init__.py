"""Escalation: what is matched again for images that no model has, or is not sure of.

``policy`` decides by the chances and costs of ``expected_gain``; ``escalate`` carries it out;
``map_and_rematch`` goes on between mapping and matching; ``alternatives`` are models of other
matches.
"""
