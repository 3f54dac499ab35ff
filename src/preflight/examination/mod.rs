//! The examination of a Qube before a session. It finds faults without driving the arm far.
//!
//! The examination runs on the control thread, between motions. To test the watchdog, the motor
//! gets 48 mV until the watchdog switches it off: after 50 to 55 ms on a board, and after at most
//! 100 ms with the vendor's library. Then pushes of at most 0.1 s each way test encoders and motor:
//! they begin with 0.25 V and grow, up to 2.75 V, until the evidence suffices; an arm that they
//! have moved is braked. If the watchdog is the vendor library's, another test comes before these
//! pushes: pushes of 0.05 s in the same range of voltages show whether the watchdog really switches
//! the motor off. A watchdog that fails this test leaves the motor on for 0.3 s. A watchdog that
//! fails the first test may leave 48 mV on until the hello with which the examination then ends.
//! After every other step the motor is off, however the step ends.

mod evidence;
mod examined_device;
mod link;
mod motion;
mod rest;
mod silent_push;
mod swing_fit;
mod watchdog;

use std::sync::atomic::AtomicBool;

use self::examined_device::ExaminedDevice;
use self::watchdog::WatchdogTest;
use crate::clock::Clock;
use crate::control::warn_off_unconfirmed;
use crate::device::{Device, DeviceError, Identity};
use crate::estimation::Calibration;
use crate::qube::PlantModel;
use crate::safety::MotorHeat;
use crate::telemetry::{CheckResult, Fault, MeasuredLink};

const HOMING: &str = "homing";

/// The assumptions about a Qube that an examination starts from.
#[derive(Clone, Debug)]
pub struct ExaminationSettings {
    /// Signs of encoders and motor.
    pub signs: Calibration,
    /// Reaction to signs that differ from the assumed ones.
    pub other_signs: OtherSigns,
    /// Identity of the device from its hello.
    pub identity: Identity,
    /// Plant that is examined.
    pub plant: PlantModel,
}

/// The reaction of an examination to signs that differ from the assumed ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OtherSigns {
    /// The check of the signs fails.
    Fail,
    /// The examination adopts the signs that it found.
    Adopt,
}

/// The result of an examination.
#[derive(Clone, Debug, PartialEq)]
pub struct Examination {
    /// Result of each check, in order.
    pub results: Vec<CheckResult>,
    /// Fault that ended a push or the test of the watchdog, if one did. The caller has to latch it.
    pub fault: Option<Fault>,
    /// Signs that the examination found, if it was to adopt them, arm and pendulum moved, and no
    /// fault ended a push; otherwise the assumed ones.
    pub signs: Calibration,
    /// Count of the arm before anything moved it; it is the arm's middle if the operator has put
    /// the arm there. `None` if no sample came.
    pub start_theta_counts: Option<i32>,
    /// Link that the examination measured.
    pub link: Option<MeasuredLink>,
    /// Time from the last act until the vendor library's watchdog had expired, ms, if the motor was
    /// seen to go off by it. `None` for a board's watchdog.
    pub library_watchdog_ms: Option<f64>,
}

impl Examination {
    /// Returns whether no check failed.
    #[must_use]
    pub fn passed(&self) -> bool {
        !self.results.iter().any(CheckResult::failed)
    }
}

/// The reason why an examination did not finish.
#[derive(Debug)]
pub(super) enum Interruption {
    /// A stop was requested.
    Stopped,
    /// The device failed: its port is gone, it no longer answers or refuses to be armed, the Qube
    /// is off, or it or the board has restarted.
    Device(DeviceError),
}

impl From<DeviceError> for Interruption {
    fn from(error: DeviceError) -> Self {
        Self::Device(error)
    }
}

/// Examines a device that has answered a hello, and adds the heat of the pushes that test encoders
/// and motor to `heat`. A hello at the end switches the motor off; if the device no longer answers,
/// only its watchdog can. `Ok(None)`: a stop was requested, and the device answered that hello.
///
/// # Errors
/// The port is gone, the Qube is off, it or the board has restarted, the link loses too many
/// samples or acts, or the device no longer answers or refuses to be armed for a push.
pub fn examine(
    device: &mut dyn Device,
    clock: &dyn Clock,
    heat: &mut MotorHeat,
    stop: &AtomicBool,
    settings: &ExaminationSettings,
) -> Result<Option<Examination>, DeviceError> {
    let mut found = Examination {
        results: Vec::new(),
        fault: None,
        signs: settings.signs,
        start_theta_counts: None,
        link: None,
        library_watchdog_ms: None,
    };
    let mut examined =
        ExaminedDevice { device: &mut *device, clock, stop, port: &settings.identity.port };
    let outcome = run_checks(&mut examined, heat, settings, &mut found);
    // A hello switches off a device that still answers; one whose emergency stop was opened is off.
    let left_off = device.hello();
    match outcome {
        // The caller latches the fault, whatever the device answers afterwards.
        Ok(()) if found.fault.is_some_and(Fault::leaves_doubt) => {
            if let Err(error) = left_off {
                warn_off_unconfirmed(&error);
            }
            Ok(Some(found))
        }
        Err(Interruption::Stopped) => left_off.map(|_| None),
        Err(Interruption::Device(error)) => Err(error),
        Ok(()) => left_off.map(|_| Some(found)),
    }
}

fn run_checks(
    examined: &mut ExaminedDevice<'_>,
    heat: &mut MotorHeat,
    settings: &ExaminationSettings,
    found: &mut Examination,
) -> Result<(), Interruption> {
    let identity = &settings.identity;
    let round_trips = link::measure(examined, link::SAMPLES)?;
    found.results.push(link::identity(identity, &round_trips));
    found.link = Some(adopt_link(examined.device, &round_trips));
    found.start_theta_counts = round_trips.theta_counts;
    found.results.push(link::latency_timer(&identity.port, &round_trips));
    found.results.push(link::latency(&identity.port, &round_trips));
    let WatchdogTest { result: watchdog, expired_ms, fault } = watchdog::check(examined)?;
    let may_move = !watchdog.failed();
    found.results.push(watchdog);
    found.fault = fault;
    if !may_move {
        motion::skip(found, "needs a working watchdog");
        return Ok(());
    }
    let rest = rest::wait(examined, settings.plant.encoders)?;
    let may_move = !rest.failed();
    found.results.push(rest);
    if !may_move {
        motion::skip(found, "needs a pendulum at rest");
        return Ok(());
    }
    if !examined.device.has_device_clock() {
        let motor = silent_push::check(examined, settings.plant.encoders.theta)?;
        let may_move = !motor.failed();
        found.results.push(motor);
        if !may_move {
            motion::skip(found, "needs a working watchdog");
            return Ok(());
        }
        found.library_watchdog_ms = expired_ms;
    }
    motion::check(examined, heat, settings, found)
}

/// Measures a link without an examination, and sets the device's longest wait for a sample to fit
/// the link. A sample without an answer counts as lost. `Ok(None)`: a stop was requested.
///
/// # Errors
/// The port is gone, the Qube is off, or it or the board has restarted.
pub fn measure_link(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    port: &str,
) -> Result<Option<MeasuredLink>, DeviceError> {
    let mut examined = ExaminedDevice { device: &mut *device, clock, stop, port };
    match link::measure(&mut examined, link::FEW_SAMPLES) {
        Ok(round_trips) => Ok(Some(adopt_link(device, &round_trips))),
        Err(Interruption::Stopped) => Ok(None),
        Err(Interruption::Device(error)) => Err(error),
    }
}

fn adopt_link(device: &mut dyn Device, round_trips: &link::RoundTrips) -> MeasuredLink {
    let link = round_trips.link();
    device.set_sample_time_ns(u64::from(link.sample_time_us) * 1000);
    link
}

/// Returns whether the test of the watchdog failed, so that nothing may be run with this device.
#[must_use]
pub fn watchdog_failed(results: &[CheckResult]) -> bool {
    let is_of_watchdog = |name: &str| [watchdog::NAME, silent_push::NAME].contains(&name);
    results.iter().any(|result| result.failed() && is_of_watchdog(&result.name))
}

/// The result of the check of homing that passed and found these zeros.
#[must_use]
pub fn homed(zeros: &Calibration) -> CheckResult {
    CheckResult::pass(
        HOMING,
        format!(
            "middle of the arm at count {}, the pendulum hangs at count {}",
            zeros.theta_zero_counts, zeros.alpha_zero_counts
        ),
    )
}

/// The result of the check of homing that failed, because this fault ended the homing.
#[must_use]
pub fn not_homed(fault: Fault) -> CheckResult {
    // The remedy is never homing by hand, which would rely on the encoder or the motor that is in
    // doubt.
    let remedy = format!("{} Then check again", fault.operator_step());
    CheckResult::fail(HOMING, fault.to_string(), remedy)
}

/// The result of the check of homing that was skipped, because an earlier check failed.
#[must_use]
pub fn homing_left_out() -> CheckResult {
    CheckResult::skipped(HOMING, "not before all else passes")
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::Ordering;

    use super::*;
    use crate::clock::{Nanoseconds, VirtualClock};
    use crate::device::emulator::EmulatorSettings;
    use crate::device::{LinkFault, SerialLink};
    use crate::qube::{Encoder, Encoders, Measurement, State};

    /// An emulated board whose first act requests a stop, and whose samples are lost from then on
    /// until the next hello.
    struct StoppedByItsFirstAct<'a> {
        board: Box<dyn Device>,
        clock: VirtualClock,
        stop: &'a AtomicBool,
        stopped_ns: Option<Nanoseconds>,
        greeted_ns: Nanoseconds,
    }

    impl Device for StoppedByItsFirstAct<'_> {
        fn hello(&mut self) -> Result<Identity, DeviceError> {
            self.greeted_ns = self.clock.now_ns();
            self.board.hello()
        }

        fn arm(&mut self) -> Result<(), DeviceError> {
            self.board.arm()
        }

        fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
            if self.stopped_ns.is_some_and(|stopped_ns| self.greeted_ns < stopped_ns) {
                self.clock.sleep_until(deadline_ns);
                return Err(LinkFault::Timeout);
            }
            self.board.sample(deadline_ns)
        }

        fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
            self.stop.store(true, Ordering::Relaxed);
            self.stopped_ns.get_or_insert(self.clock.now_ns());
            self.board.act(voltage_mv, sampled_at_us)
        }

        fn disarm(&mut self) -> Result<(), DeviceError> {
            self.board.disarm()
        }
    }

    #[test]
    fn a_stop_while_the_watchdog_is_tested_ends_the_examination_with_the_motor_off() {
        let clock = VirtualClock::default();
        let board = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
        let stop = AtomicBool::new(false);
        let mut device = StoppedByItsFirstAct {
            board: Box::new(board),
            clock: clock.clone(),
            stop: &stop,
            stopped_ns: None,
            greeted_ns: 0,
        };
        let settings = settings(device.hello().unwrap());
        let heat = &mut MotorHeat::default();
        let found = examine(&mut device, &clock, heat, &stop, &settings).unwrap();
        assert_eq!(found, None);
        let late_ns = device.greeted_ns - device.stopped_ns.unwrap();
        assert!(late_ns < 40_000_000, "{late_ns} ns");
        assert!(!device.sample(clock.now_ns() + 20_000_000).unwrap().status.armed);
    }

    /// An emulated board whose samples are lost from the second one after an act until 0.1 s after
    /// the act.
    struct LosesSamples {
        board: Box<dyn Device>,
        clock: VirtualClock,
        acted_ns: Option<Nanoseconds>,
        samples_since_act: u32,
    }

    impl Device for LosesSamples {
        fn hello(&mut self) -> Result<Identity, DeviceError> {
            self.acted_ns = None;
            self.board.hello()
        }

        fn arm(&mut self) -> Result<(), DeviceError> {
            self.board.arm()
        }

        fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
            self.samples_since_act += 1;
            let lost_until_ns = self.acted_ns.map_or(0, |acted_ns| acted_ns + 100_000_000);
            if self.samples_since_act > 1 && self.clock.now_ns() < lost_until_ns {
                self.clock.sleep_until(deadline_ns);
                return Err(LinkFault::Timeout);
            }
            self.board.sample(deadline_ns)
        }

        fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
            (self.acted_ns, self.samples_since_act) = (Some(self.clock.now_ns()), 0);
            self.board.act(voltage_mv, sampled_at_us)
        }

        fn disarm(&mut self) -> Result<(), DeviceError> {
            self.board.disarm()
        }
    }

    #[test]
    fn a_watchdog_that_is_not_seen_to_trip_in_time_does_not_pass() {
        let clock = VirtualClock::default();
        let board = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
        let mut device = LosesSamples {
            board: Box::new(board),
            clock: clock.clone(),
            acted_ns: None,
            samples_since_act: 0,
        };
        let settings = settings(device.hello().unwrap());
        let (heat, stop) = (&mut MotorHeat::default(), AtomicBool::new(false));
        let found = examine(&mut device, &clock, heat, &stop, &settings).unwrap().unwrap();
        assert!(watchdog_failed(&found.results), "{:#?}", found.results);
    }

    fn settings(identity: Identity) -> ExaminationSettings {
        ExaminationSettings {
            signs: Calibration::IDENTITY,
            other_signs: OtherSigns::Fail,
            identity,
            plant: PlantModel::QUBE,
        }
    }

    /// An emulated board that counts as hardware, and whose first push suffers this `mishap`.
    struct Mishandled<'a> {
        board: Box<dyn Device>,
        clock: VirtualClock,
        mishap: Mishap,
        stop: &'a AtomicBool,
        /// Motions so far: the test of the watchdog, then each push.
        armed: u32,
        /// Acts since the device was last armed.
        acts: u32,
    }

    #[derive(Clone, Copy, Debug, PartialEq)]
    enum Mishap {
        /// The computer stands still for this long, ns, before the third act.
        StandsStill(Nanoseconds),
        /// The device confirms no disarm.
        Unconfirmed,
        /// A stop is requested, and the device answers nothing more.
        SilentAfterStop,
    }

    impl Mishandled<'_> {
        fn is_pushed(&self) -> bool {
            self.armed == 2
        }

        fn timeout<T>() -> Result<T, DeviceError> {
            Err(DeviceError::Link { port: "test".into(), fault: LinkFault::Timeout })
        }

        fn is_silent(&self) -> bool {
            self.mishap == Mishap::SilentAfterStop && self.stop.load(Ordering::Relaxed)
        }
    }

    impl Device for Mishandled<'_> {
        fn hello(&mut self) -> Result<Identity, DeviceError> {
            if self.is_silent() { Self::timeout() } else { self.board.hello() }
        }

        fn arm(&mut self) -> Result<(), DeviceError> {
            (self.armed, self.acts) = (self.armed + 1, 0);
            self.board.arm()
        }

        fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
            self.board.sample(deadline_ns)
        }

        fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
            self.acts += 1;
            if self.is_pushed() && self.acts == 3 {
                match self.mishap {
                    Mishap::StandsStill(pause_ns) => self.clock.advance(pause_ns),
                    Mishap::SilentAfterStop => self.stop.store(true, Ordering::Relaxed),
                    Mishap::Unconfirmed => {}
                }
            }
            self.board.act(voltage_mv, sampled_at_us)
        }

        fn disarm(&mut self) -> Result<(), DeviceError> {
            self.board.disarm()?;
            let is_lost = self.mishap == Mishap::Unconfirmed && self.is_pushed();
            if is_lost || self.is_silent() { Self::timeout() } else { Ok(()) }
        }
    }

    /// The result of an examination whose first push goes wrong, and the number of its motions.
    fn examined(mishap: Mishap) -> (Result<Option<Examination>, DeviceError>, u32) {
        let clock = VirtualClock::default();
        let board = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
        let stop = AtomicBool::new(false);
        let (board, armed, acts) = (Box::new(board), 0, 0);
        let mut device =
            Mishandled { board, clock: clock.clone(), mishap, stop: &stop, armed, acts };
        let settings = settings(device.hello().unwrap());
        let heat = &mut MotorHeat::default();
        let found = examine(&mut device, &clock, heat, &stop, &settings);
        (found, device.armed)
    }

    /// The only failed check of an examination.
    fn failed_check(found: Result<Option<Examination>, DeviceError>) -> CheckResult {
        let results = found.unwrap().unwrap().results;
        let mut failed = results.into_iter().filter(CheckResult::failed);
        let result = failed.next().expect("one check of the examination fails");
        assert_eq!(failed.next(), None);
        result
    }

    #[test]
    fn a_computer_that_slept_in_a_push_ends_the_examination() {
        let (late, motions) = examined(Mishap::StandsStill(200_000_000));
        assert!(late.unwrap().unwrap().passed());
        assert_eq!(motions, 3, "the push is repeated");
        let (slept, motions) = examined(Mishap::StandsStill(60_000_000_000));
        let failed = failed_check(slept);
        assert_eq!((failed.name.as_str(), motions), ("motor", 2), "{failed:?}");
        assert!(failed.value.contains(&Fault::ComputerSlept.to_string()), "{failed:?}");
    }

    #[test]
    fn a_push_whose_motor_nobody_confirmed_to_be_off_ends_the_examination() {
        let (found, motions) = examined(Mishap::Unconfirmed);
        let failed = failed_check(found);
        assert_eq!((failed.name.as_str(), motions), ("motor", 2), "{failed:?}");
        let remedy = failed.remedy.unwrap();
        assert!(remedy.starts_with("Switch the Qube off"), "{remedy}");
    }

    #[test]
    fn a_stopped_examination_says_if_nobody_confirmed_that_the_motor_is_off() {
        let (stopped, motions) = examined(Mishap::SilentAfterStop);
        assert_eq!(motions, 2);
        assert!(matches!(stopped, Err(DeviceError::Link { .. })), "{stopped:?}");
    }

    #[test]
    fn a_qube_with_finer_encoders_and_a_pendulum_that_hardly_swings_passes() {
        for counts in [4096, 1 << 16, 1 << 20] {
            let encoder = Encoder::try_from(counts).unwrap();
            let encoders = Encoders { theta: encoder, alpha: encoder };
            let plant = PlantModel { encoders, ..PlantModel::QUBE };
            let start = Some(State { alpha: 0.005, ..State::default() });
            let emulated = EmulatorSettings { start, ..EmulatorSettings::default() };
            let clock = VirtualClock::default();
            let mut board = SerialLink::in_process(emulated.of_plant(&plant), clock.clone());
            let settings = ExaminationSettings {
                signs: Calibration { encoders, ..Calibration::IDENTITY },
                other_signs: OtherSigns::Fail,
                identity: board.hello().unwrap(),
                plant,
            };
            let (heat, stop) = (&mut MotorHeat::default(), AtomicBool::new(false));
            let found = examine(&mut board, &clock, heat, &stop, &settings).unwrap().unwrap();
            assert!(found.passed(), "{counts} counts: {:#?}", found.results);
        }
    }

    #[test]
    fn no_fault_of_homing_is_answered_with_homing_by_hand() {
        for fault in Fault::ALL {
            let result = not_homed(*fault);
            let remedy = result.remedy.unwrap();
            assert!(
                !remedy.contains("hand and") && !remedy.contains("--home"),
                "{fault}: {remedy}"
            );
            assert!(remedy.ends_with("check again") && remedy.len() > 30, "{fault}: {remedy}");
        }
    }
}
