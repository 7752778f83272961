"""Which worlds make which steps when: in lock step, each at its own pace, each with its own Δt, or in several processes. Built on
steppers and on `records`; it never imports the simulator."""
