use super::TickInput;
use crate::qube::Status;
use crate::telemetry::Fault;

/// Longest time without a valid sample, ns. Single late or lost answers are no fault: stalls of 13
/// to 20 ms occur on healthy links.
const MAX_BLIND_NS: u64 = 35_000_000;

/// Lateness above which a tick counts as late, ns.
const MAX_LATENESS_NS: u64 = 10_000_000;

/// Late ticks that are a fault, if no tick in time lies between them. Ticks without a valid sample
/// are not counted, neither as late nor as in time.
const MAX_LATE_TICKS: u32 = 5;

/// Time by which the device's clock may gain on the computer's between two samples, us; a larger
/// gain is a wrong clock.
const CLOCK_LEAP_US: u64 = 1_000_000;

/// Consecutive odd intervals that prove a wrong device clock. An interval is odd if it is less than
/// half or more than twice the computer's: less than 5 ms or more than 20 ms for a tick of 10 ms.
/// Fewer odd intervals can result from one late and one early sample.
const MAX_ODD_INTERVALS: u32 = 3;

/// Interval of the second, more precise comparison of the clocks, us.
const RATE_WINDOW_US: u64 = 500_000;

/// Tolerance of the second comparison, as a fraction: a crystal is off by 0.005, and answers come
/// up to 10 ms late.
const RATE_TOLERANCE: f64 = 0.1;

/// The reaction that a fault requires.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alarm {
    /// Switch the amplifier off at once, because link, clock, amplifier, motor or the arm's count
    /// cannot be trusted, or the emergency stop is pressed. A rollout first damps the arm after a
    /// fault for which [`Fault::doubts_count`] is true.
    SwitchOff(Fault),
    /// Stop the arm first, because link, amplifier and the arm's count can be trusted; then switch
    /// the amplifier off.
    Brake(Fault),
}

/// The alarm of one tick to act on: the first that switches the motor off at once, otherwise the
/// first of all. An overheated motor or a late computer gives an alarm in each tick, also while the
/// brake works, and must not hide a fault of the arm.
pub fn most_urgent<const N: usize>(alarms: [Option<Alarm>; N]) -> Option<Alarm> {
    let mut given = alarms.into_iter().flatten();
    given.clone().find(|alarm| matches!(alarm, Alarm::SwitchOff(_))).or_else(|| given.next())
}

/// The fault of the Qube, or the emergency stop, because of which a device with this status has
/// switched its motor off; `None` if it reports none.
#[must_use]
pub fn reported_fault(status: &Status) -> Option<Fault> {
    if status.emergency_stop {
        Some(Fault::EmergencyStop)
    } else if status.amplifier_fault {
        Some(Fault::Amplifier)
    } else {
        status.stall_error.then_some(Fault::StallError)
    }
}

/// Checks link, timing and the device's status flags, for every kind of motion.
#[derive(Clone, Copy, Debug, Default)]
pub struct Watch {
    last_valid_ns: Option<u64>,
    /// Number of late ticks with a valid sample since the last tick in time.
    late_ticks: u32,
    clock: ClockWatch,
    ignores_clock: bool,
}

/// Compares the device's clock with the computer's.
#[derive(Clone, Copy, Debug, Default)]
struct ClockWatch {
    /// Request time, ns, and device time, us, of the last sample.
    last: Option<(u64, u64)>,
    odd_in_a_row: u32,
    /// Request time, ns, and device time, us, of the sample with which the second comparison began.
    long_since: Option<(u64, u64)>,
}

impl ClockWatch {
    /// Returns whether the device's clock is wrong: it stops (as for a repeated sample), leaps
    /// forward, goes back, or runs at another rate. `asked_ns` is the computer's time of the
    /// request.
    fn is_wrong(&mut self, asked_ns: u64, device_us: u64) -> bool {
        let Some((last_ns, last_us)) = self.last.replace((asked_ns, device_us)) else {
            return false;
        };
        let host_us = asked_ns.saturating_sub(last_ns) / 1000;
        let elapsed_us = device_us.saturating_sub(last_us);
        let is_odd = elapsed_us * 2 < host_us || elapsed_us > host_us * 2;
        self.odd_in_a_row = if is_odd { self.odd_in_a_row + 1 } else { 0 };
        elapsed_us == 0
            || elapsed_us > host_us + CLOCK_LEAP_US
            || self.odd_in_a_row >= MAX_ODD_INTERVALS
            || self.is_wrong_for_long(asked_ns, device_us)
    }

    /// Returns whether the clock's rate is wrong by an amount that single periods do not show.
    fn is_wrong_for_long(&mut self, asked_ns: u64, device_us: u64) -> bool {
        let (since_ns, since_us) = *self.long_since.get_or_insert((asked_ns, device_us));
        let host_us = asked_ns.saturating_sub(since_ns) / 1000;
        if host_us < RATE_WINDOW_US {
            return false;
        }
        self.long_since = Some((asked_ns, device_us));
        let elapsed_us = device_us.saturating_sub(since_us);
        elapsed_us.abs_diff(host_us) as f64 > RATE_TOLERANCE * host_us as f64
    }
}

impl Watch {
    /// A watch by the first rules, under which recordings of protocol 1 were made: it does not
    /// compare the clocks.
    #[must_use]
    pub fn of_the_first_rules() -> Self {
        Self { ignores_clock: true, ..Self::default() }
    }

    /// Checks one tick's input; returns the first alarm.
    pub fn check(&mut self, input: &TickInput) -> Option<Alarm> {
        if let Some(loss) = input.device_loss {
            return Some(Alarm::SwitchOff(loss.fault()));
        }
        let last_valid_ns = *self.last_valid_ns.get_or_insert(input.deadline_ns);
        let Some(measurement) = &input.measurement else {
            let blind_ns = input.deadline_ns.saturating_sub(last_valid_ns);
            return (blind_ns > MAX_BLIND_NS).then_some(Alarm::SwitchOff(Fault::NoSample));
        };
        self.last_valid_ns = Some(input.deadline_ns);
        // An emergency stop is named before anything else that may be wrong, also after a sleep of
        // the computer, because no program goes on by itself after an emergency stop.
        if measurement.status.emergency_stop {
            return Some(Alarm::SwitchOff(Fault::EmergencyStop));
        }
        let asked_ns = input.deadline_ns + input.lateness_ns;
        if !self.ignores_clock && self.clock.is_wrong(asked_ns, measurement.device_time_us) {
            return Some(Alarm::SwitchOff(Fault::DeviceClock));
        }
        if measurement.status.watchdog_tripped {
            return Some(Alarm::SwitchOff(Fault::WatchdogTripped));
        }
        if let Some(fault) = reported_fault(&measurement.status) {
            return Some(Alarm::SwitchOff(fault));
        }
        if !measurement.status.armed {
            return Some(Alarm::SwitchOff(Fault::NotArmed));
        }
        if input.motor_overheated {
            return Some(Alarm::Brake(Fault::MotorOverheated));
        }
        let late = input.lateness_ns > MAX_LATENESS_NS;
        self.late_ticks = if late { self.late_ticks + 1 } else { 0 };
        (self.late_ticks >= MAX_LATE_TICKS).then_some(Alarm::Brake(Fault::TooLate))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::DeviceLoss;
    use crate::qube::Measurement;

    const PERIOD_NS: u64 = 10_000_000;

    fn input(tick: u64) -> TickInput {
        let status = Status { armed: true, ..Status::default() };
        let device_time_us = 777 + tick * PERIOD_NS / 1000;
        TickInput {
            deadline_ns: tick * PERIOD_NS,
            measurement: Some(Measurement { device_time_us, status, ..Measurement::default() }),
            ..TickInput::default()
        }
    }

    /// Feeds a watch with samples at these device times; returns the tick at which it reports a
    /// wrong clock, if it does.
    fn ticks_until_wrong(device_time_us: impl Fn(u64) -> u64) -> Option<u64> {
        let mut watch = Watch::default();
        (0..200).find(|&tick| {
            let mut input = input(tick);
            let sample = input.measurement.as_mut().unwrap();
            sample.device_time_us = device_time_us(tick);
            let alarm = watch.check(&input);
            assert!(alarm.is_none() || alarm == Some(Alarm::SwitchOff(Fault::DeviceClock)));
            alarm.is_some()
        })
    }

    #[test]
    fn a_sample_that_repeats_and_a_clock_that_goes_wrong_are_a_fault() {
        assert_eq!(ticks_until_wrong(|tick| 10_000 * tick.min(50)), Some(51));
        // Back to an older sample, as a 32-bit clock extended to 64 bits shows it.
        let back =
            |tick| if tick < 20 { 10_000 * tick } else { 10_000 * tick + (1 << 32) - 50_000 };
        assert_eq!(ticks_until_wrong(back), Some(20));
        assert_eq!(ticks_until_wrong(|tick| 4_900 * tick), Some(3));
        assert_eq!(ticks_until_wrong(|tick| 20_100 * tick), Some(3));
        // A rate that is in order for each single period, but not over fifty of them.
        assert_eq!(ticks_until_wrong(|tick| 19_000 * tick), Some(51));
        assert_eq!(ticks_until_wrong(|tick| 8_900 * tick), Some(51));
        // A crystal's error, answers that are late in turn, and a single late answer are no error.
        assert_eq!(ticks_until_wrong(|tick| 10_050 * tick), None);
        assert_eq!(ticks_until_wrong(|tick| 10_000 * tick + 5_900 * (tick % 2)), None);
        assert_eq!(ticks_until_wrong(|tick| 10_000 * tick + 9_900 * u64::from(tick > 70)), None);
    }

    #[test]
    fn a_clock_is_compared_over_lost_samples_and_skipped_periods() {
        let mut watch = Watch::default();
        for tick in [0, 1, 4, 5, 8, 9, 12, 15, 16] {
            assert_eq!(watch.check(&input(tick)), None);
        }
        let repeated = TickInput { deadline_ns: 18 * PERIOD_NS, ..input(16) };
        assert_eq!(watch.check(&repeated), Some(Alarm::SwitchOff(Fault::DeviceClock)));
    }

    #[test]
    fn recordings_of_the_first_rules_replay_whatever_the_clock_said() {
        let mut watch = Watch::of_the_first_rules();
        for tick in 0..50 {
            let repeated = TickInput { deadline_ns: tick * PERIOD_NS, ..input(tick.min(7)) };
            assert_eq!(watch.check(&repeated), None);
        }
    }

    #[test]
    fn an_emergency_stop_is_named_before_what_it_leads_to() {
        let status = Status { emergency_stop: true, ..Status::default() };
        let measurement = Some(Measurement { status, ..Measurement::default() });
        let alarm = Watch::default().check(&TickInput { measurement, ..input(0) });
        assert_eq!(alarm, Some(Alarm::SwitchOff(Fault::EmergencyStop)));
    }

    #[test]
    fn an_emergency_stop_is_named_after_a_sleep_of_the_computer_too() {
        let mut watch = Watch::default();
        assert_eq!(watch.check(&input(0)), None);
        let mut slept = input(1);
        let sample = slept.measurement.as_mut().unwrap();
        sample.device_time_us += 60_000_000;
        let mut stopped = slept;
        stopped.measurement.as_mut().unwrap().status.emergency_stop = true;
        assert_eq!(watch.check(&stopped), Some(Alarm::SwitchOff(Fault::EmergencyStop)));
        assert_eq!(watch.check(&slept), Some(Alarm::SwitchOff(Fault::DeviceClock)));
    }

    #[test]
    fn a_qube_that_is_switched_off_is_named_at_once() {
        let off =
            TickInput { measurement: None, device_loss: Some(DeviceLoss::QubeOff), ..input(1) };
        assert_eq!(Watch::default().check(&off), Some(Alarm::SwitchOff(Fault::QubeOff)));
    }

    #[test]
    fn three_lost_samples_are_held_over_and_the_fourth_is_a_fault() {
        let mut watch = Watch::default();
        assert_eq!(watch.check(&input(10)), None);
        for tick in 11..14 {
            assert_eq!(watch.check(&TickInput { measurement: None, ..input(tick) }), None);
        }
        let fourth = TickInput { measurement: None, ..input(14) };
        assert_eq!(watch.check(&fourth), Some(Alarm::SwitchOff(Fault::NoSample)));
    }

    #[test]
    fn one_valid_sample_between_lost_ones_is_enough() {
        let mut watch = Watch::default();
        for tick in 0..40 {
            let lost = tick % 3 != 0;
            let mut input = input(tick);
            if lost {
                input.measurement = None;
            }
            assert_eq!(watch.check(&input), None);
        }
    }

    #[test]
    fn five_late_ticks_in_a_row_are_a_fault_and_four_are_not() {
        let mut watch = Watch::default();
        for tick in 0..30 {
            let late = tick % 5 != 4;
            let input = TickInput { lateness_ns: if late { 11_000_000 } else { 0 }, ..input(tick) };
            assert_eq!(watch.check(&input), None);
        }
        let alarms = [30, 31, 32, 33, 34]
            .map(|tick| watch.check(&TickInput { lateness_ns: 11_000_000, ..input(tick) }));
        assert_eq!(alarms[3], None);
        assert_eq!(alarms[4], Some(Alarm::Brake(Fault::TooLate)));
    }

    #[test]
    fn a_tick_without_a_sample_is_neither_late_nor_in_time() {
        let mut watch = Watch::default();
        let late = |tick| TickInput { lateness_ns: 11_000_000, ..input(tick) };
        let lost = |tick| TickInput { measurement: None, ..late(tick) };
        let inputs = [late(0), late(1), lost(2), late(3), lost(4), lost(5), late(6)];
        for input in inputs {
            assert_eq!(watch.check(&input), None);
        }
        assert_eq!(watch.check(&late(7)), Some(Alarm::Brake(Fault::TooLate)));
    }

    #[test]
    fn an_overheated_motor_brakes_and_hides_no_fault_of_the_link() {
        let hot = TickInput { motor_overheated: true, ..input(0) };
        let alarm = Watch::default().check(&hot);
        assert_eq!(alarm, Some(Alarm::Brake(Fault::MotorOverheated)));
        let gone = TickInput { device_loss: Some(DeviceLoss::LinkGone), ..hot };
        assert_eq!(Watch::default().check(&gone), Some(Alarm::SwitchOff(Fault::LinkGone)));
    }

    #[test]
    fn the_flags_that_a_device_reports_are_faults() {
        for (status, fault) in [
            (
                Status { armed: true, watchdog_tripped: true, ..Status::default() },
                Fault::WatchdogTripped,
            ),
            (Status { armed: true, amplifier_fault: true, ..Status::default() }, Fault::Amplifier),
            (Status { armed: true, stall_error: true, ..Status::default() }, Fault::StallError),
            (Status::default(), Fault::NotArmed),
        ] {
            let measurement = Some(Measurement { status, ..Measurement::default() });
            let alarm = Watch::default().check(&TickInput { measurement, ..input(0) });
            assert_eq!(alarm, Some(Alarm::SwitchOff(fault)));
        }
    }
}
