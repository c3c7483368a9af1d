"""Recurrent agents that learn action values: Recurrent-Q SARSA, its auxiliary objectives, its siblings and rivals."""
