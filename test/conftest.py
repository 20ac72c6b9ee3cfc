"""Settings of all tests."""

from hypothesis import settings

# Time is measured in benchmarks; on a busy machine a deadline would fail a test that is right.
settings.register_profile("octn", deadline=None)
settings.load_profile("octn")
