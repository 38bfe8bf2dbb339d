"""Mutation testing of the safety-critical modules: does a test fail for every small change of their code?"""
