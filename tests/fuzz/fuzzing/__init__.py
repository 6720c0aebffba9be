"""Mutated input for every reader and command, run in forked processes with limits and judged by what they leave."""
