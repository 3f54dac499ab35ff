//! The real-time thread: one tick (read, estimate, decide, guard, write, record), deadlines, homing.
//!
//! May import `clock`, `device`, `estimation`, `policy`, `safety`, `telemetry`, `qube`; never
//! anything that allocates, locks or touches a file.
