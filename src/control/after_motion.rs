use super::DriveReport;
use crate::device::DeviceError;
use crate::qube::CONTROL_PERIOD_NS;
use crate::telemetry::{Consequence, Ending, Fault, TickRecord};

/// Time between two ticks of a motion from which the computer counts as having slept, us. Nobody at
/// the Qube then expects that the program continues by itself.
const SLEEP_US: u64 = 2_000_000;

/// The fault to which the program reacts after a motion: the fault of its ending, or one that only
/// the whole report shows; `None` after a motion without a fault. With an emulated Qube, a sleep of
/// the computer is no fault.
///
/// A fault that ends the run or leaves a doubt comes first. Then comes a device that answers that
/// its motor is still on, which is a defect of the board and not of the link
/// ([`Fault::StaysArmed`]), then a sleep of the computer, which ends the run whatever else happened
/// meanwhile. If the motor is not confirmed to be off, the log reports it, and the result is
/// [`Fault::OffUnconfirmed`], unless one of these, or a lost link, is the result.
/// [`DriveReport::disarmed`] shows whether the motor was confirmed to be off.
#[must_use]
pub fn fault_after(report: &DriveReport, is_hardware: bool) -> Option<Fault> {
    let fault = match report.outcome.ending {
        Ending::Fault(fault) => Some(fault),
        _ => None,
    };
    if let Err(error) = &report.disarmed {
        warn_off_unconfirmed(error);
    }
    let stays_armed = matches!(report.disarmed, Err(DeviceError::StaysArmed { .. }));
    match fault.map(Fault::consequence) {
        Some(Consequence::Examine | Consequence::End) => fault,
        _ if stays_armed => Some(Fault::StaysArmed),
        _ if is_hardware && has_slept(report) => Some(Fault::ComputerSlept),
        Some(Consequence::Reconnect) => fault,
        Some(Consequence::TryAgain) | None if report.disarmed.is_err() => {
            Some(Fault::OffUnconfirmed)
        }
        Some(Consequence::TryAgain) | None => fault,
    }
}

/// Tells the operator, in the log, that a motor is not confirmed to be off, and what to do.
pub fn warn_off_unconfirmed(error: &DeviceError) {
    let unconfirmed = Fault::OffUnconfirmed;
    tracing::warn!("{unconfirmed}: {error}. {}", unconfirmed.operator_step());
}

/// Returns whether the computer slept during the motion: its clock stood still while it was
/// suspended, or a tick was late or periods were skipped because the program stood still.
///
/// The device's clock shows a pause in which the computer counted no time at all, as that of a
/// virtual machine. A device's clock that went back shows a gap of more than half its range, which
/// is no sleep.
fn has_slept(report: &DriveReport) -> bool {
    let skipped_us = |tick: &TickRecord| u64::from(tick.skipped_periods) * CONTROL_PERIOD_NS / 1000;
    let late_us = |tick: &TickRecord| tick.lateness_ns / 1000;
    let ticks = &report.last_ticks;
    let sampled_us: Vec<u64> = ticks
        .iter()
        .filter_map(|tick| tick.measurement.map(|sample| sample.device_time_us))
        .collect();
    let went_on = |pair: &[u64]| (SLEEP_US..1 << 31).contains(&pair[1].saturating_sub(pair[0]));
    report.suspended_ns / 1000 >= SLEEP_US
        || ticks.iter().any(|tick| skipped_us(tick).max(late_us(tick)) >= SLEEP_US)
        || sampled_us.windows(2).any(went_on)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::LinkFault;
    use crate::qube::Measurement;
    use crate::telemetry::{LatencySummary, Phase, RolloutOutcome};

    fn report(ending: Ending) -> DriveReport {
        let outcome = RolloutOutcome {
            ending,
            phase: Phase::Running,
            steps: 0,
            missed_deadlines: 0,
            records_lost: 0,
            observer_resets: 0,
            foreseen: None,
            contradiction: None,
            largest_motor_load: None,
            last_answer_v: None,
            lateness_us: LatencySummary::default(),
            sample_to_act_us: LatencySummary::default(),
        };
        let ticks = (0..3).map(|tick| TickRecord {
            measurement: Some(Measurement {
                device_time_us: 10_000 * tick,
                ..Measurement::default()
            }),
            ..TickRecord::default()
        });
        DriveReport {
            outcome,
            last_measurement: None,
            last_ticks: ticks.collect(),
            suspended_ns: 0,
            disarmed: Ok(()),
        }
    }

    fn unconfirmed(ending: Ending) -> DriveReport {
        let silent = DeviceError::Link { port: "/dev/qube".into(), fault: LinkFault::Timeout };
        DriveReport { disarmed: Err(silent), ..report(ending) }
    }

    #[test]
    fn a_motor_that_nobody_confirmed_to_be_off_is_a_fault_whatever_ended_the_motion() {
        assert_eq!(fault_after(&report(Ending::Completed), true), None);
        for ending in [Ending::Completed, Ending::Stopped, Ending::Fault(Fault::NoSample)] {
            assert_eq!(fault_after(&unconfirmed(ending), true), Some(Fault::OffUnconfirmed));
        }
        for fault in [Fault::LinkGone, Fault::EmergencyStop, Fault::NotANumber] {
            assert_eq!(fault_after(&unconfirmed(Ending::Fault(fault)), true), Some(fault));
        }
    }

    #[test]
    fn a_computer_that_slept_ends_the_run_and_a_late_one_does_not() {
        let clock = report(Ending::Fault(Fault::DeviceClock));
        assert_eq!(fault_after(&clock, true), Some(Fault::DeviceClock));
        let mut suspended = report(Ending::Fault(Fault::DeviceClock));
        suspended.last_ticks[2].measurement.as_mut().unwrap().device_time_us += 60_000_000;
        assert_eq!(fault_after(&suspended, true), Some(Fault::ComputerSlept));
        let mut stopped = report(Ending::Fault(Fault::WatchdogTripped));
        stopped.last_ticks[2].skipped_periods = 300;
        assert_eq!(fault_after(&stopped, true), Some(Fault::ComputerSlept));
        assert_eq!(
            fault_after(&stopped, false),
            Some(Fault::WatchdogTripped),
            "a sleep is no fault of an emulated Qube"
        );
        // No fault of the link and no motor that may be on hides a sleep, however long it was.
        for ending in
            [Ending::Completed, Ending::Fault(Fault::LinkGone), Ending::Fault(Fault::DeviceClock)]
        {
            for minutes in [1, 40, 600] {
                let sleep_ns = minutes * 60_000_000_000;
                let mut late = unconfirmed(ending);
                late.last_ticks[2].lateness_ns = sleep_ns;
                let suspended = DriveReport { suspended_ns: sleep_ns, ..report(ending) };
                for slept in [late, suspended] {
                    assert_eq!(fault_after(&slept, true), Some(Fault::ComputerSlept), "{minutes}");
                }
            }
        }
        let doubt = DriveReport {
            suspended_ns: 60_000_000_000,
            ..report(Ending::Fault(Fault::EncoderFrozen))
        };
        assert_eq!(fault_after(&doubt, true), Some(Fault::EncoderFrozen));
        let mut went_back = report(Ending::Fault(Fault::DeviceClock));
        went_back.last_ticks[2].measurement.as_mut().unwrap().device_time_us += (1 << 32) - 50_000;
        assert_eq!(fault_after(&went_back, true), Some(Fault::DeviceClock));
        let mut late = report(Ending::Fault(Fault::WatchdogTripped));
        late.last_ticks[2].skipped_periods = 30;
        assert_eq!(fault_after(&late, true), Some(Fault::WatchdogTripped));
    }
}
