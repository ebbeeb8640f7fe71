"""Identification of drives from a log of a robot that hangs in the air: rotors, friction, encoders, one delay."""
