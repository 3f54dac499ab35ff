use std::sync::Arc;
use std::time::Duration;

use super::card_service::{CardOperation, CardService, Request, RequestKind, Unperformed};
use super::panel::NoSample;
use super::{HilAddress, HilError};
use crate::clock::{Clock, Nanoseconds};
use crate::device::{Device, DeviceError, Identity, LinkFault, MAX_SAMPLE_AGE_NS};
use crate::qube::Measurement;

/// Longest wait for a hello: opening a card, or connecting to a virtual one, may take seconds.
const HELLO_TIME: Duration = Duration::from_secs(5);

/// Longest wait for an arm, which makes several calls of the library.
const ARM_TIME: Duration = Duration::from_secs(1);

/// Longest wait for the amplifier to go off.
const OFF_TIME: Duration = Duration::from_millis(500);

/// A Qube with the USB panel, as a [`Device`] over the vendor's library.
///
/// The library gives no time of a sample. [`Measurement::device_time_us`] is the computer's time at
/// which the read began; the age of the counts at that time is unknown.
pub struct HilLink {
    service: CardService,
    address: HilAddress,
    clock: Arc<dyn Clock>,
    number: u64,
    /// True if a hello was answered and no fault has been latched since.
    is_greeted: bool,
    is_armed: bool,
    /// Device time, us, of the last sample since the last hello, and the time of its request, ns.
    last_sample: Option<(u64, Nanoseconds)>,
    is_tripped: bool,
    sample_time_ns: Option<Nanoseconds>,
}

impl HilLink {
    /// Loads the vendor's library. No card is opened before the first hello.
    ///
    /// # Errors
    /// The library is not found, cannot be loaded, or lacks a function because it is of another
    /// version; or the thread that calls the library cannot start, ends, or does not load the
    /// library in time, as when it is in an earlier call.
    pub fn open(address: &HilAddress, clock: Arc<dyn Clock>) -> Result<Self, DeviceError> {
        let service = CardService::start(address.clone(), Arc::clone(&clock))?;
        Ok(Self {
            service,
            address: address.clone(),
            clock,
            number: 0,
            is_greeted: false,
            is_armed: false,
            last_sample: None,
            is_tripped: false,
            sample_time_ns: None,
        })
    }

    /// Runs an operation between motions on the library's thread, and waits for at most `longest`.
    fn perform<T>(
        &self,
        operation: impl FnOnce(crossbeam_channel::Sender<Result<T, HilError>>) -> CardOperation,
        longest: Duration,
    ) -> Result<T, DeviceError> {
        self.service.perform(operation, longest).map_err(|unperformed| match unperformed {
            Unperformed::NoResult => self.hung(longest).into(),
            Unperformed::Failed(error) => error.into(),
        })
    }

    fn hung(&self, longest: Duration) -> HilError {
        let port = self.address.to_string();
        let (function, waited_s) =
            self.service.under_way().unwrap_or(("a call", longest.as_secs_f64()));
        HilError::Hung { port, function, waited_s }
    }

    fn ask(&mut self, expires_ns: Nanoseconds, kind: RequestKind) -> Result<u64, LinkFault> {
        self.number += 1;
        let request = Request { number: self.number, expires_ns, kind };
        if self.service.ask(request) { Ok(self.number) } else { Err(LinkFault::Full) }
    }
}

impl Device for HilLink {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        (self.is_greeted, self.is_armed, self.is_tripped) = (false, false, false);
        self.last_sample = None;
        let identity = self.perform(CardOperation::Hello, HELLO_TIME)?;
        self.is_greeted = true;
        Ok(identity)
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        if !self.is_greeted {
            return Err(HilError::NotGreeted { port: self.address.to_string() }.into());
        }
        self.perform(CardOperation::Arm, ARM_TIME)?;
        self.is_armed = true;
        Ok(())
    }

    fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
        let asked_ns = self.clock.now_ns();
        let number = self.ask(deadline_ns, RequestKind::Sample)?;
        let reply = self.service.wait(number, deadline_ns).ok_or(LinkFault::Timeout)?;
        let measurement = match reply.sample {
            Ok(measurement) => measurement,
            Err(NoSample::Gone) => return Err(LinkFault::Gone),
            Err(NoSample::Failed) => return Err(LinkFault::Timeout),
        };
        if self.is_armed && !measurement.status.armed {
            self.is_armed = false;
            self.is_tripped = measurement.status.watchdog_tripped;
            // The fault stays latched until the next hello.
            self.is_greeted = false;
        }
        self.last_sample = Some((measurement.device_time_us, asked_ns));
        Ok(measurement)
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        if !self.is_armed {
            let tripped = self.is_tripped;
            return Err(if tripped { LinkFault::WatchdogTripped } else { LinkFault::NotArmed });
        }
        let last = self.last_sample.filter(|(sampled_us, _)| *sampled_us == sampled_at_us);
        let (_, asked_ns) = last.ok_or(LinkFault::StaleSample)?;
        let expires_ns = asked_ns + MAX_SAMPLE_AGE_NS;
        if self.clock.now_ns() > expires_ns {
            return Err(LinkFault::StaleSample);
        }
        self.ask(expires_ns, RequestKind::Act { voltage_mv, sampled_at_us }).map(|_| ())
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.is_armed = false;
        self.perform(CardOperation::Off, OFF_TIME)
    }

    fn has_device_clock(&self) -> bool {
        false
    }

    fn sample_time_ns(&self) -> Option<Nanoseconds> {
        self.sample_time_ns
    }

    fn set_sample_time_ns(&mut self, sample_time_ns: Nanoseconds) {
        self.sample_time_ns = Some(sample_time_ns);
    }
}

impl Drop for HilLink {
    /// Switches the amplifier off and closes the card, also when the control thread panics.
    fn drop(&mut self) {
        self.service.end(OFF_TIME);
    }
}
