//! Tests whether a device keeps the promises of `PROTOCOL.md`. Each check has a name and tests one
//! promise. The checks exchange bytes with any device over its wire: the emulator, the firmware, or
//! another implementation.
//!
//! The checks use the protocol crate and a transport, but not the host's side of the link, because
//! a fault there could hide a fault of the device. The motor gets at most 1 V, for a few
//! milliseconds; the checks of the watchdog leave up to 0.5 V on until the watchdog switches it
//! off, 50 to 55 ms later, the check of stale samples holds 0.25 V for more than 20 ms, and the
//! check of flipped bits holds 0.25 V while it sends its frames. The checks test a device's
//! deadlines by the device's own clock, so that a busy computer fails no device.

mod acting;
mod arming;
mod framing;
mod greeting;
mod staleness;
mod starts;
mod test_host;
mod watchdog;

use thiserror::Error;

pub use test_host::TestHost;

use crate::device::LinkFault;

/// A promise of the protocol and its test.
#[derive(Clone, Copy, Debug)]
pub struct ConformanceCheck {
    /// Name of the check; it stays the same in later versions.
    pub name: &'static str,
    /// The promise of the protocol, in a sentence.
    pub promise: &'static str,
    run: fn(&mut TestHost<'_>) -> Result<(), Deviation>,
}

/// The reason why a device did not pass a check.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum Deviation {
    /// The device did something other than the protocol says.
    #[error("{0}")]
    Wrong(String),
    /// The device did not answer a request.
    #[error("{0} was not answered")]
    Silent(&'static str),
    /// The connection to the device failed.
    #[error("the wire failed: {0}")]
    Link(#[from] LinkFault),
    /// The computer was too slow: the watchdog tripped during the check, or an act came too late
    /// after its sample. This says nothing about the device, so the check is repeated.
    #[error(
        "the computer was too slow in every attempt: the watchdog tripped before the check was \
         complete, or an act came too late after its sample"
    )]
    Disturbed,
    /// An act was refused as stale although it followed the request of its sample within 8 ms.
    #[error(
        "an act was refused as stale although it came {elapsed_us} us after the request of its sample"
    )]
    FreshRefused {
        /// Time from the request of the sample to the act, by the computer's clock, us.
        elapsed_us: u64,
    },
}

/// Largest number of attempts of a check. More than one is needed, because the computer may be too
/// slow for the watchdog.
const ATTEMPTS: u32 = 20;

/// Number of attempts that may end with a refusal of a fresh act: on a busy computer an emulated
/// device may read an act 20 ms late; a real device does not depend on the computer's load.
const FRESH_REFUSALS: usize = 3;

impl ConformanceCheck {
    /// Runs this check, repeats it while the computer disturbs it, and leaves the device's motor
    /// off.
    ///
    /// # Errors
    /// The deviation that the check found; [`Deviation::Disturbed`] if the computer disturbed every
    /// attempt; or the failure of the hello before or after the check.
    pub fn run(&self, test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
        let mut result = Err(Deviation::Disturbed);
        let mut fresh_refusals = 0;
        for _ in 0..ATTEMPTS {
            test_host.resynchronise()?;
            result = (self.run)(test_host);
            match result {
                Err(Deviation::Disturbed) => {}
                Err(Deviation::FreshRefused { .. }) if fresh_refusals < FRESH_REFUSALS => {
                    fresh_refusals += 1;
                }
                _ => break,
            }
        }
        let left_off = test_host.resynchronise();
        result.and(left_off)
    }
}

/// All checks; those that others rely on come first.
pub const CHECKS: &[ConformanceCheck] = &[
    ConformanceCheck {
        name: "hello",
        promise: "a hello is answered with version, identity, the Qube's module id and a nonce",
        run: greeting::hello,
    },
    ConformanceCheck {
        name: "fresh-nonce",
        promise: "each hello gives another nonce",
        run: greeting::fresh_nonce,
    },
    ConformanceCheck {
        name: "version-mismatch",
        promise: "a hello of another version is answered, and nothing else is done after it",
        run: greeting::version_mismatch,
    },
    ConformanceCheck {
        name: "sample",
        promise: "a sample is answered while the motor is off, each shows a later reading, and reserved bits are 0",
        run: greeting::sample,
    },
    ConformanceCheck {
        name: "device-clock",
        promise: "the device's clock runs as fast as the computer's, within 1 %",
        run: greeting::device_clock,
    },
    ConformanceCheck {
        name: "module-id",
        promise: "with any other module id than a Qube's, Sample and Arm are refused as QubeAbsent",
        run: starts::module_id,
    },
    ConformanceCheck {
        name: "boot-id",
        promise: "the boot id stays the same from one start to the next",
        run: starts::boot_id,
    },
    ConformanceCheck {
        name: "counts-continue",
        promise: "counts do not jump by a hello, an arm, a disarm or another version's hello",
        run: starts::counts_continue,
    },
    ConformanceCheck {
        name: "last-act-before-arm",
        promise: "last_act_sequence is 0 from a hello to the next arm",
        run: starts::last_act_before_arm,
    },
    ConformanceCheck {
        name: "arm-clears-stall",
        promise: "the first sample after an arm shows no stall error that was there before",
        run: starts::arm_clears_stall,
    },
    ConformanceCheck {
        name: "arm",
        promise: "the right nonce arms, at 0 V; disarming switches off and gives a new nonce",
        run: arming::arm,
    },
    ConformanceCheck {
        name: "wrong-nonce",
        promise: "a wrong nonce does not arm and leaves the right one valid",
        run: arming::wrong_nonce,
    },
    ConformanceCheck {
        name: "replayed-arm",
        promise: "a nonce arms once",
        run: arming::replayed_arm,
    },
    ConformanceCheck {
        name: "arm-twice",
        promise: "an armed device refuses another arm, which does not feed its watchdog",
        run: arming::arm_twice,
    },
    ConformanceCheck {
        name: "hello-disarms",
        promise: "a hello switches an armed device off",
        run: arming::hello_disarms,
    },
    ConformanceCheck {
        name: "act-unarmed",
        promise: "an act on a device that is not armed is refused",
        run: acting::unarmed,
    },
    ConformanceCheck {
        name: "act",
        promise: "an act reaches the motor, quantised, and shows in the next sample with its times",
        run: acting::act,
    },
    ConformanceCheck {
        name: "first-act-time",
        promise: "the time from a sample to its act ends with the first act on it",
        run: acting::first_act_time,
    },
    ConformanceCheck {
        name: "act-out-of-range",
        promise: "an act of more than 5000 mV is refused and changes nothing",
        run: acting::out_of_range,
    },
    ConformanceCheck {
        name: "replayed-act",
        promise: "an act that is not newer than the last is refused and changes nothing",
        run: acting::replayed,
    },
    ConformanceCheck {
        name: "sequence-wrap",
        promise: "sequence numbers go on from 65535 to 0",
        run: acting::sequence_wrap,
    },
    ConformanceCheck {
        name: "stale-sample",
        promise: "an act that names no sample, another than the last, or one of more than 20 ms ago is refused",
        run: staleness::refused,
    },
    ConformanceCheck {
        name: "watchdog-not-fed-by-stale",
        promise: "acts that answer no fresh sample do not feed the watchdog",
        run: staleness::does_not_feed,
    },
    ConformanceCheck {
        name: "watchdog",
        promise: "50 ms to 55 ms after the last act the motor goes off, although samples are requested",
        run: watchdog::on_time,
    },
    ConformanceCheck {
        name: "watchdog-after-arm",
        promise: "the watchdog runs from arming on, also when no act comes",
        run: watchdog::after_arm,
    },
    ConformanceCheck {
        name: "watchdog-not-fed-by-refused",
        promise: "refused acts do not feed the watchdog",
        run: watchdog::not_fed_by_refused,
    },
    ConformanceCheck {
        name: "watchdog-fed",
        promise: "acts keep the device armed",
        run: watchdog::fed,
    },
    ConformanceCheck {
        name: "watchdog-latch",
        promise: "only a hello leads out of the tripped state, and only the next arm clears the status bit",
        run: watchdog::latch,
    },
    ConformanceCheck {
        name: "garbage",
        promise: "garbage is dropped in silence and counted, and the next request is answered",
        run: framing::garbage,
    },
    ConformanceCheck {
        name: "flipped-bits",
        promise: "a frame with any bit flipped does nothing",
        run: framing::flipped_bits,
    },
    ConformanceCheck {
        name: "truncated-frame",
        promise: "a frame cut off anywhere does nothing and harms no other",
        run: framing::truncated,
    },
    ConformanceCheck {
        name: "unknown-type",
        promise: "an unknown type and a wrong length are refused, each for its own reason",
        run: framing::unknown,
    },
    ConformanceCheck {
        name: "reply-type",
        promise: "frames of the reply types are dropped in silence and counted",
        run: framing::reply_types,
    },
    ConformanceCheck {
        name: "back-to-back",
        promise: "two requests that are sent together are both answered, in order",
        run: framing::back_to_back,
    },
];

/// Fails a check unless a condition holds.
macro_rules! ensure {
    ($condition:expr, $($message:tt)+) => {
        if !$condition {
            return Err($crate::preflight::conformance::Deviation::Wrong(format!($($message)+)));
        }
    };
}
use ensure;

#[cfg(test)]
mod tests;
