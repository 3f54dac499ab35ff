//! A simulated Qube behind the trait [`Device`] for the tests of this room. There is no wire
//! between test and Qube, so that a test can place a fault at a chosen tick.

use crate::clock::{Clock, Nanoseconds, VirtualClock};
use crate::device::{Device, DeviceError, Identity, LinkFault};
use crate::estimation::{Calibration, EstimatorSettings};
use crate::qube::{
    CONTROL_PERIOD_NS, DomainParameters, Dynamics, HARD_STOP_RAD, Measurement, PlantModel,
    RAD_PER_COUNT, State, Status, counts, runge_kutta_4,
};
use crate::safety::SafetyBox;
use crate::telemetry::{TickRules, TickSettings};

/// The settings of a rollout of a nominal Qube in the thesis's box, from the middle.
pub fn rollout_settings(max_steps: u32) -> TickSettings {
    TickSettings {
        calibration: Calibration::IDENTITY,
        estimator: EstimatorSettings::default(),
        safety_box: SafetyBox::THESIS,
        max_steps,
        start_theta_rad: 0.0,
        stops: None,
        foresight: None,
        rules: TickRules::NEWEST,
        plant: PlantModel::QUBE,
    }
}

/// A disturbance of a tick's sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TestFault {
    /// The request for the sample is not answered in time.
    Lost,
    /// The port is gone.
    Gone,
    /// The sample takes this long, ns.
    Slow(u64),
    /// The device reports this status.
    Reports(Status),
    /// The device reports the arm's last count and no velocity of it.
    FrozenArm,
}

/// The way in which the device answers a disarm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TestDisarm {
    /// Its motor is off, and the device confirms it.
    Obeyed,
    /// Its motor is off, and no answer comes.
    Unanswered,
    /// The device confirms that its motor is off, although it stays on.
    Ignored,
}

/// A nominal Qube between two hard stops, simulated up to the time of `clock` with each sample, act
/// and disarm.
pub struct PlantDevice {
    pub state: State,
    pub clock: VirtualClock,
    /// The disturbance of each sample, by its number from 0.
    pub disturbance: Box<dyn Fn(u32) -> Option<TestFault> + Send>,
    /// The blow that changes the plant's state before each sample, by its number from 0.
    pub blow: fn(u32, &mut State),
    /// Counts that both encoders show at zero angle.
    pub offset_counts: i32,
    pub armed: bool,
    /// Voltage of an armed motor that ignores all acts, mV; `None` if the motor follows the acts.
    pub stuck_mv: Option<i16>,
    /// Its answer to a disarm.
    pub disarm: TestDisarm,
    /// Voltages of all acts, mV.
    pub voltages_mv: Vec<i16>,
    /// Largest distance of the arm from the middle so far, rad.
    pub furthest_rad: f64,
    /// Time until which hellos are not answered, ns.
    pub deaf_until_ns: Nanoseconds,
    /// Times of all hellos, ns.
    pub hellos_ns: Vec<Nanoseconds>,
    dynamics: Dynamics,
    simulated_ns: Nanoseconds,
    voltage_mv: i16,
    samples: u32,
    /// Count of the arm in the last sample.
    theta_counts: i32,
}

impl PlantDevice {
    pub fn new(state: State) -> Self {
        Self {
            state,
            clock: VirtualClock::default(),
            disturbance: Box::new(|_| None),
            blow: |_, _| (),
            offset_counts: 0,
            armed: false,
            stuck_mv: None,
            disarm: TestDisarm::Obeyed,
            voltages_mv: Vec::new(),
            furthest_rad: 0.0,
            deaf_until_ns: 0,
            hellos_ns: Vec::new(),
            dynamics: Dynamics::new(&DomainParameters::NOMINAL),
            simulated_ns: 0,
            voltage_mv: 0,
            samples: 0,
            theta_counts: 0,
        }
    }

    fn current_a(&self) -> f32 {
        let motor = DomainParameters::NOMINAL;
        let back_emf_v = motor.motor_back_emf_v_s * self.state.theta_dot;
        let voltage_v = f64::from(self.voltage_mv) * 1e-3;
        ((voltage_v - back_emf_v) / motor.motor_resistance_ohm) as f32
    }

    fn catch_up(&mut self) {
        let now_ns = self.clock.now_ns();
        while self.simulated_ns < now_ns {
            let step_ns = (now_ns - self.simulated_ns).min(CONTROL_PERIOD_NS / 20);
            let voltage_v = f64::from(self.voltage_mv) * 1e-3;
            let step_s = step_ns as f64 * 1e-9;
            self.state = runge_kutta_4(&self.dynamics, self.state, voltage_v, step_s);
            if self.state.theta.abs() > HARD_STOP_RAD {
                let stop_rad = HARD_STOP_RAD.copysign(self.state.theta);
                self.state = self.dynamics.with_arm_stopped(self.state, stop_rad);
            }
            self.furthest_rad = self.furthest_rad.max(self.state.theta.abs());
            self.simulated_ns += step_ns;
        }
    }
}

impl Device for PlantDevice {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        self.hellos_ns.push(self.clock.now_ns());
        if self.clock.now_ns() < self.deaf_until_ns {
            return Err(DeviceError::Link { port: "none".into(), fault: LinkFault::Gone });
        }
        Ok(Identity {
            kind: "plant".into(),
            serial: String::new(),
            firmware_version: String::new(),
            protocol_version: 0,
            boot_id: 0,
            counts_anew: false,
            port: "none".into(),
        })
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.armed = true;
        self.voltage_mv = self.stuck_mv.unwrap_or(0);
        Ok(())
    }

    fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
        self.catch_up();
        let tick = self.samples;
        self.samples += 1;
        (self.blow)(tick, &mut self.state);
        let mut status = Status { armed: self.armed, ..Status::default() };
        let mut tachometer_counts_s = (self.state.theta_dot / RAD_PER_COUNT) as i32;
        let mut theta_counts = counts(self.state.theta) + self.offset_counts;
        match (self.disturbance)(tick) {
            Some(TestFault::Lost) => {
                self.clock.sleep_until(deadline_ns);
                return Err(LinkFault::Timeout);
            }
            Some(TestFault::Gone) => return Err(LinkFault::Gone),
            Some(TestFault::Slow(duration_ns)) => self.clock.advance(duration_ns),
            Some(TestFault::Reports(reported)) => status = reported,
            Some(TestFault::FrozenArm) => {
                (theta_counts, tachometer_counts_s) = (self.theta_counts, 0);
            }
            None => {}
        }
        self.theta_counts = theta_counts;
        Ok(Measurement {
            device_time_us: self.simulated_ns / 1000,
            theta_counts,
            alpha_counts: counts(self.state.alpha) + self.offset_counts,
            status,
            tachometer_counts_s,
            applied_mv: self.voltage_mv,
            current_a: self.current_a(),
            ..Measurement::default()
        })
    }

    fn act(&mut self, voltage_mv: i16, _sampled_at_us: u64) -> Result<(), LinkFault> {
        self.catch_up();
        self.voltage_mv = self.stuck_mv.unwrap_or(voltage_mv);
        self.voltages_mv.push(voltage_mv);
        Ok(())
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.catch_up();
        if self.disarm == TestDisarm::Ignored {
            return Ok(());
        }
        self.armed = false;
        self.voltage_mv = 0;
        match self.disarm {
            TestDisarm::Unanswered => {
                Err(DeviceError::Link { port: "none".into(), fault: LinkFault::Timeout })
            }
            TestDisarm::Obeyed | TestDisarm::Ignored => Ok(()),
        }
    }

    fn is_hardware(&self) -> bool {
        false
    }
}
