"""Blind injection: effects hidden by code that shares nothing with the critic, sealed until it has spoken."""
