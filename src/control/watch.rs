use super::TickInput;
use crate::telemetry::Fault;

/// Longest time without a valid sample, ns. One late or lost answer is held over: stalls of 13 to
/// 20 ms have been seen on healthy links.
const MAX_BLIND_NS: u64 = 35_000_000;

/// A tick that wakes later than this after its deadline is too late, ns ...
const MAX_LATENESS_NS: u64 = 10_000_000;

/// ... and so many of them in a row are a fault.
const MAX_LATE_TICKS: u32 = 5;

/// What a fault leaves to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alarm {
    /// The link or the amplifier cannot be trusted: off at once.
    Zero(Fault),
    /// The link lives: stop the arm first.
    Brake(Fault),
}

/// Watches link, timing and the device's own flags, for each kind of motion alike.
#[derive(Clone, Copy, Debug, Default)]
pub struct Watch {
    last_valid_ns: Option<u64>,
    late_in_a_row: u32,
}

impl Watch {
    /// Looks at one tick's input.
    pub fn check(&mut self, input: &TickInput) -> Option<Alarm> {
        if input.link_gone {
            return Some(Alarm::Zero(Fault::LinkGone));
        }
        if input.board_restarted {
            return Some(Alarm::Zero(Fault::BoardRestarted));
        }
        let last_valid_ns = *self.last_valid_ns.get_or_insert(input.deadline_ns);
        let Some(measurement) = &input.measurement else {
            let blind_ns = input.deadline_ns.saturating_sub(last_valid_ns);
            return (blind_ns > MAX_BLIND_NS).then_some(Alarm::Zero(Fault::NoSample));
        };
        self.last_valid_ns = Some(input.deadline_ns);
        if measurement.status.watchdog_tripped {
            return Some(Alarm::Zero(Fault::WatchdogTripped));
        }
        if measurement.status.amplifier_fault {
            return Some(Alarm::Zero(Fault::Amplifier));
        }
        if measurement.status.stall_error {
            return Some(Alarm::Zero(Fault::StallError));
        }
        if !measurement.status.armed {
            return Some(Alarm::Zero(Fault::NotArmed));
        }
        if input.motor_overheated {
            return Some(Alarm::Brake(Fault::MotorOverheated));
        }
        let late = input.lateness_ns > MAX_LATENESS_NS;
        self.late_in_a_row = if late { self.late_in_a_row + 1 } else { 0 };
        (self.late_in_a_row >= MAX_LATE_TICKS).then_some(Alarm::Brake(Fault::TooLate))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{Measurement, Status};

    const PERIOD_NS: u64 = 10_000_000;

    fn input(tick: u64) -> TickInput {
        let status = Status { armed: true, ..Status::default() };
        TickInput {
            deadline_ns: tick * PERIOD_NS,
            measurement: Some(Measurement { status, ..Measurement::default() }),
            ..TickInput::default()
        }
    }

    #[test]
    fn three_lost_samples_are_held_over_and_the_fourth_is_a_fault() {
        let mut watch = Watch::default();
        assert_eq!(watch.check(&input(10)), None);
        for tick in 11..14 {
            assert_eq!(watch.check(&TickInput { measurement: None, ..input(tick) }), None);
        }
        let fourth = TickInput { measurement: None, ..input(14) };
        assert_eq!(watch.check(&fourth), Some(Alarm::Zero(Fault::NoSample)));
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
        let late = TickInput { lateness_ns: 11_000_000, ..input(30) };
        let alarms = [(); 5].map(|()| watch.check(&late));
        assert_eq!(alarms[3], None);
        assert_eq!(alarms[4], Some(Alarm::Brake(Fault::TooLate)));
    }

    #[test]
    fn an_overheated_motor_brakes_and_hides_no_fault_of_the_link() {
        let hot = TickInput { motor_overheated: true, ..input(0) };
        let alarm = Watch::default().check(&hot);
        assert_eq!(alarm, Some(Alarm::Brake(Fault::MotorOverheated)));
        let gone = TickInput { link_gone: true, ..hot };
        assert_eq!(Watch::default().check(&gone), Some(Alarm::Zero(Fault::LinkGone)));
    }

    #[test]
    fn what_the_device_says_of_itself_is_believed() {
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
            assert_eq!(alarm, Some(Alarm::Zero(fault)));
        }
    }
}
