use std::sync::atomic::{AtomicBool, Ordering};

use super::after_motion::warn_off_unconfirmed;
use super::last_ticks::LastTicks;
use super::latency::LatencyHistogram;
use super::{DeviceLoss, Motion, TickInput};
use crate::clock::{Clock, Nanoseconds};
use crate::device::{Device, DeviceError};
use crate::qube::{CONTROL_PERIOD_NS, Measurement};
use crate::safety::MotorHeat;
use crate::telemetry::{Ending, MotorState, Phase, RolloutOutcome, TickRecord};

/// Time that a tick waits for its sample, ns, unless a measurement has shown that the link needs
/// longer. An act that follows a sample at 6 ms leaves well before the next tick. Without a sample
/// by then, the tick sends nothing and the device keeps its last voltage.
pub const SAMPLE_TIMEOUT_NS: u64 = 6_000_000;

/// Longest time that a tick waits for its sample, ns, even on a link that needs longer. This limit
/// leaves 1.5 ms of the tick's 10 ms: 0.1 ms to decide, and 1.3 ms until an act reaches the motor
/// (1 ms for a frame of USB, 0.26 ms for 13 bytes on the line). An act then follows its sample
/// within 10 ms, inside the 20 ms that foresight allows for and that a device accepts.
pub const LONGEST_SAMPLE_TIMEOUT_NS: u64 = 8_500_000;

/// The result of driving one motion to its end.
#[derive(Debug)]
pub struct DriveReport {
    /// Ending, counters and latencies.
    pub outcome: RolloutOutcome,
    /// Last measurement, if there was any.
    pub last_measurement: Option<Measurement>,
    /// The last second before a fault, oldest tick first; empty without a fault. A motor that is
    /// not confirmed to be off is a fault, too.
    pub last_ticks: Vec<TickRecord>,
    /// Time for which the computer was suspended during the motion, ns.
    pub suspended_ns: Nanoseconds,
    /// `Ok` if the device confirmed that its amplifier is off. If the device has received no
    /// disarm, its watchdog switches the amplifier off; on a board at most 55 ms after the last arm
    /// or act.
    pub disarmed: Result<(), DeviceError>,
}

impl DriveReport {
    /// State of the motor after the motion.
    #[must_use]
    pub fn motor(&self) -> MotorState {
        match self.disarmed {
            Ok(()) => MotorState::Off,
            Err(_) => MotorState::Unconfirmed,
        }
    }
}

/// Arms the device, runs one motion at 100 Hz on absolute deadlines until the motion ends, and
/// disarms the device. After a panic of the motion, the backend of a real Qube switches the
/// amplifier off when it is dropped.
///
/// Each tick does five things in this order: wait, read, decide, write, record. None of them
/// allocates, locks, logs or waits for the recorder: `records` is a wait-free ring, and a record
/// that finds the ring full is counted as lost. For a motion that is not recorded, `records` is
/// `None`. Only a controller that another program supplies, such as one in Python, may lock and
/// wait for its answer, at most until a deadline within the tick.
///
/// `heat` is the motor's heat before the motion, and becomes its heat afterwards.
///
/// # Errors
/// The device could not be armed; nothing has moved then. A device that has not refused is
/// disarmed, because only its answer may be lost.
pub fn drive(
    device: &mut dyn Device,
    clock: &dyn Clock,
    motion: &mut dyn Motion,
    heat: &mut MotorHeat,
    mut records: Option<&mut rtrb::Producer<TickRecord>>,
    stop: &AtomicBool,
) -> Result<DriveReport, DeviceError> {
    let mut lateness = LatencyHistogram::new();
    let mut sample_to_act = LatencyHistogram::new();
    let mut counts = TickCounts::default();
    let mut last_ticks = LastTicks::new();
    let mut voltage_mv = 0;
    let mut largest_motor_load = heat.load;

    // Held until this function returns, on every way out.
    let _awake = clock.stay_awake();
    let sample_time_ns = device.sample_time_ns().unwrap_or(SAMPLE_TIMEOUT_NS);
    let suspended_before_ns = clock.suspended_ns();
    if let Err(error) = device.arm() {
        // The order may have reached a device whose answer was lost.
        if !matches!(error, DeviceError::Refused { .. })
            && let Err(unconfirmed) = device.disarm()
        {
            warn_off_unconfirmed(&unconfirmed);
        }
        return Err(error);
    }
    let mut deadline_ns = clock.now_ns() + CONTROL_PERIOD_NS;
    let mut skipped_periods = 0;
    let (ending, phase) = loop {
        // Wait for the deadline.
        clock.sleep_until(deadline_ns);
        let woke_ns = clock.now_ns();
        let lateness_ns = woke_ns.saturating_sub(deadline_ns);
        lateness.record(lateness_ns);

        // Read.
        let sample = device.sample(woke_ns + sample_time_ns);
        let input = TickInput {
            deadline_ns,
            lateness_ns,
            skipped_periods,
            stop_requested: stop.load(Ordering::Relaxed),
            measurement: sample.ok(),
            device_loss: sample.err().and_then(DeviceLoss::of),
            motor_overheated: heat.is_overheated(),
        };

        // Decide: estimate, guard, policy, limit.
        let output = motion.decide(&input);

        // Write. An act belongs to the sample of its own tick: without a sample nothing is sent,
        // and the device keeps its last voltage until the next act or its watchdog. The device also
        // keeps its voltage after an act that is lost on the way; the next sample shows the loss.
        if output.ending.is_none()
            && let Some(sample) = &input.measurement
        {
            let _ = device.act(motion.device_mv(output.voltage_mv), sample.device_time_us);
        }
        let turnaround_ns = clock.now_ns() - woke_ns;

        // Update the motor's heat by the voltage that acted until now.
        let measurement = input.measurement.as_ref();
        heat.pass(skipped_periods, measurement, voltage_mv, output.heating_theta_dot_rad_s);
        largest_motor_load = largest_motor_load.max(heat.load);
        voltage_mv = output.voltage_mv;

        // Record.
        let record = TickRecord {
            tick: counts.ticks,
            phase: output.phase,
            deadline_ns,
            lateness_ns,
            skipped_periods,
            stop_requested: input.stop_requested,
            measurement: input.measurement,
            state: output.state,
            wanted_v: output.wanted_v,
            voltage_mv: output.voltage_mv,
            turnaround_ns,
        };
        let pushed = records.as_mut().is_none_or(|records| records.push(record).is_ok());
        last_ticks.push(&record);
        counts.count(&record, pushed);
        if let Some(latency_us) = input.measurement.and_then(|sample| sample.sample_to_act_us) {
            sample_to_act.record(u64::from(latency_us) * 1000);
        }
        if let Some(ending) = output.ending {
            break (ending, output.phase);
        }

        // The next deadline. Whole periods that have passed are skipped, never made up in a burst.
        deadline_ns += CONTROL_PERIOD_NS;
        let behind_ns = clock.now_ns().saturating_sub(deadline_ns);
        skipped_periods = (behind_ns / CONTROL_PERIOD_NS) as u32;
        deadline_ns += u64::from(skipped_periods) * CONTROL_PERIOD_NS;
    };

    // The last act may have left a voltage, so the amplifier goes off before anything else happens.
    let disarmed = device.disarm();
    Ok(DriveReport {
        outcome: RolloutOutcome {
            ending,
            phase,
            steps: counts.steps,
            missed_deadlines: counts.missed_deadlines,
            records_lost: counts.records_lost,
            observer_resets: motion.observer_resets(),
            foreseen: motion.foreseen(),
            contradiction: motion.contradiction(),
            largest_motor_load: Some(largest_motor_load),
            last_answer_v: None,
            lateness_us: lateness.summary(),
            sample_to_act_us: sample_to_act.summary(),
        },
        last_measurement: counts.last_measurement,
        last_ticks: match (ending, &disarmed) {
            (Ending::Fault(_), _) | (_, Err(_)) => last_ticks.into_ticks(),
            _ => Vec::new(),
        },
        suspended_ns: clock.suspended_ns().saturating_sub(suspended_before_ns),
        disarmed,
    })
}

/// Counters over the ticks of one motion.
#[derive(Debug, Default)]
struct TickCounts {
    ticks: u32,
    steps: u32,
    missed_deadlines: u32,
    records_lost: u64,
    last_measurement: Option<Measurement>,
}

impl TickCounts {
    fn count(&mut self, record: &TickRecord, pushed: bool) {
        self.ticks += 1;
        self.steps += u32::from(record.phase == Phase::Running);
        self.missed_deadlines += record.missed_deadlines();
        self.records_lost += u64::from(!pushed);
        self.last_measurement = record.measurement.or(self.last_measurement);
    }
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};
    use std::path::{Path, PathBuf};
    use std::sync::Arc;
    use std::sync::atomic::AtomicUsize;

    use super::super::plant_device::{PlantDevice, TestFault};
    use super::super::{Homing, HomingMethod, HomingSettings};
    use super::*;
    use crate::clock::{AwakeProcessors, Nanoseconds, VirtualClock, openings_of};
    use crate::device::{Identity, LinkFault};
    use crate::qube::State;

    /// Virtual time, with a file in place of `/dev/cpu_dma_latency`.
    struct SleepyClock {
        time: VirtualClock,
        file: PathBuf,
    }

    impl Clock for SleepyClock {
        fn now_ns(&self) -> Nanoseconds {
            self.time.now_ns()
        }

        fn sleep_until(&self, deadline_ns: Nanoseconds) {
            self.time.sleep_until(deadline_ns);
        }

        fn stay_awake(&self) -> Option<AwakeProcessors> {
            AwakeProcessors::hold(&self.file).ok()
        }
    }

    /// A Qube that cannot be armed.
    struct Unarmed {
        plant: PlantDevice,
        disarms: u32,
    }

    impl Device for Unarmed {
        fn hello(&mut self) -> Result<Identity, DeviceError> {
            self.plant.hello()
        }

        fn arm(&mut self) -> Result<(), DeviceError> {
            Err(DeviceError::Link { port: "none".into(), fault: LinkFault::Timeout })
        }

        fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
            self.plant.sample(deadline_ns)
        }

        fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
            self.plant.act(voltage_mv, sampled_at_us)
        }

        fn disarm(&mut self) -> Result<(), DeviceError> {
            self.disarms += 1;
            self.plant.disarm()
        }
    }

    fn homing() -> Homing {
        Homing::new(&HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() })
    }

    /// Homes on a device that counts in each sample how often the file is open, and injects
    /// `disturbance`. Returns the ending (`None` after a panic) and the largest of these counts.
    fn homed_while_watched(
        file: &Path,
        disturbance: impl Fn(u32) -> Option<TestFault> + Send + 'static,
    ) -> (Option<Ending>, usize) {
        let most_openings = Arc::new(AtomicUsize::new(0));
        let (seen, watched) = (Arc::clone(&most_openings), file.to_owned());
        let mut device = PlantDevice::new(State::default());
        device.disturbance = Box::new(move |sample| {
            seen.fetch_max(openings_of(&watched), Ordering::Relaxed);
            disturbance(sample)
        });
        let clock = SleepyClock { time: device.clock.clone(), file: file.to_owned() };
        let stop = AtomicBool::new(false);
        let driven = catch_unwind(AssertUnwindSafe(|| {
            drive(&mut device, &clock, &mut homing(), &mut MotorHeat::default(), None, &stop)
                .unwrap()
                .outcome
                .ending
        }));
        (driven.ok(), most_openings.load(Ordering::Relaxed))
    }

    #[test]
    fn the_processor_is_kept_awake_while_driving_and_on_no_way_out_longer() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().canonicalize().unwrap().join("cpu_dma_latency");

        // If the file cannot be opened, driving continues without it.
        assert_eq!(homed_while_watched(&file, |_| None), (Some(Ending::Completed), 0));

        std::fs::write(&file, "").unwrap();
        assert_eq!(homed_while_watched(&file, |_| None), (Some(Ending::Completed), 1));
        assert_eq!(openings_of(&file), 0, "the file is closed after a motion");

        let gone = |sample| (sample == 20).then_some(TestFault::Gone);
        let by_fault = Some(Ending::Fault(crate::telemetry::Fault::LinkGone));
        assert_eq!(homed_while_watched(&file, gone), (by_fault, 1));
        assert_eq!(openings_of(&file), 0, "the file is closed after a fault");

        let panics =
            |sample| if sample == 20 { panic!("the motion panics on purpose") } else { None };
        assert_eq!(homed_while_watched(&file, panics), (None, 1));
        assert_eq!(openings_of(&file), 0, "the file is closed after a panic");

        let plant = PlantDevice::new(State::default());
        let clock = SleepyClock { time: plant.clock.clone(), file: file.clone() };
        let stop = AtomicBool::new(false);
        let mut unarmed = Unarmed { plant, disarms: 0 };
        assert!(
            drive(&mut unarmed, &clock, &mut homing(), &mut MotorHeat::default(), None, &stop)
                .is_err()
        );
        assert_eq!(openings_of(&file), 0, "the file is closed if the device does not arm");
        assert_eq!(unarmed.disarms, 1, "only the answer to the order may be lost");
    }
}
