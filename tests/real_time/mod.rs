//! Tests in real time, on a computer that does not always keep up.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

/// What the program says where the computer was too late for a Qube.
const TOO_LATE: &str = "keeps this computer busy";

/// How often a test is begun again.
const AGAIN: u32 = 4;

/// Runs a test whose emulated Qube is served in real time. Where it fails with what the program says of a
/// computer that is too busy, it is begun again; what is wrong with the program fails at once.
pub fn in_real_time(test: impl Fn()) {
    for _ in 0..AGAIN {
        let Err(panic) = catch_unwind(AssertUnwindSafe(&test)) else { return };
        if !panic.downcast_ref::<String>().is_some_and(|text| text.contains(TOO_LATE)) {
            resume_unwind(panic);
        }
    }
    test();
}
