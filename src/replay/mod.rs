//! A recording through the same tick again, and beside the simulator.
//!
//! May import `recording`, `control`, `policy`, `safety`, `estimation`, `simulation`, `telemetry`, `qube`.
