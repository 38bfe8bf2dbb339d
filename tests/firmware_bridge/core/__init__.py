"""Tests of the bridge's rules, link and configuration: pure, without socket, clock or protocol."""
