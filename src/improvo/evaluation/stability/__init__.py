"""Instability against its true cause on simulated recordings; the paper shows it in pictures only."""
