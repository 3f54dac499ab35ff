//! Rollouts as MCAP files: schemas, the writer thread, the reader, recovery after a crash.
//!
//! May import `telemetry`, `qube`.
