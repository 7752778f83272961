"""How much the fuzzer tries: `short` for every run of the tests, `long` with `make fuzz`.

Both draw the same inputs every time. What fails is printed as a call that does it again.
"""

from hypothesis import HealthCheck, settings

# Reading a robot or making a simulator takes tens of milliseconds, and nothing that is drawn may take more than 5 s. That is
# by the clock, and other tests run beside the short ones: these are given more, so that only what hangs fails.
settings.register_profile(
    "short",
    max_examples=25,
    derandomize=True,
    database=None,
    deadline=60_000,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.register_profile("long", settings.get_profile("short"), max_examples=2500, deadline=5000)
settings.load_profile("short")
