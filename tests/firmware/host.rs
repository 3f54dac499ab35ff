//! A host that drives a simulated board at about 100 Hz.

use std::cell::Cell;
use std::io::Write;
use std::panic::resume_unwind;
use std::sync::Arc;
use std::time::{Duration, Instant};

use qube_hil::clock::{Clock, MonotonicClock};
use qube_hil::device::{Device, LinkFault, SerialLink, Tty};
use qube_hil::qube::Measurement;

use crate::busy_computer::{STANDS_STILL, wait_for_calm, witnessed};
use crate::qube::{Command, Qube};
use crate::simulated_board::SimulatedBoard;
use crate::toolchain::{Chip, toolchain};

const PERIOD: Duration = Duration::from_millis(10);
/// Largest time between two acts; the device's watchdog is at 50 ms.
const TOO_SLOW: Duration = Duration::from_millis(40);
/// Time after which a sample counts as lost, ns.
const PATIENCE_NS: u64 = 30_000_000;

/// Interval before an order in which the Qube must have received a command with the motor on, us.
const BEFORE_ORDER_US: u64 = 10_000;

/// Largest number of attempts at a scenario, for which the computer may be too slow.
const ATTEMPTS: u32 = 6;

/// A sign that the computer was too slow for a scenario, so that its result proves nothing. It
/// counts only if the attempt's own measurements show a slow computer, too.
#[derive(Debug)]
pub struct Disturbed;

/// A board that has been greeted, and the link to it. The host drives the motor with 1 V.
pub struct Host {
    pub board: SimulatedBoard,
    pub link: SerialLink<Tty>,
}

impl Host {
    pub const VOLTAGE_MV: i16 = 1000;

    pub fn greet(board: SimulatedBoard) -> Self {
        let mut link = SerialLink::open(board.port(), Arc::new(MonotonicClock)).unwrap();
        link.hello().unwrap();
        Self { board, link }
    }

    pub fn sample(&mut self) -> Result<Measurement, LinkFault> {
        self.link.sample(MonotonicClock.now_ns() + PATIENCE_NS)
    }

    /// Requests a sample. On a computer that is too slow it times out; any other fault is the
    /// board's, and panics.
    pub fn sample_in_time(&mut self) -> Result<Measurement, Disturbed> {
        match self.sample() {
            Ok(sample) => Ok(sample),
            Err(LinkFault::Timeout) => Err(Disturbed),
            Err(fault) => panic!("the board gives no sample: {fault}"),
        }
    }

    /// Samples and acts until a sample satisfies the condition; panics if none of 200 does.
    pub fn drive_until(
        &mut self,
        mut done: impl FnMut(&Measurement) -> bool,
    ) -> Result<Measurement, Disturbed> {
        let mut last_act = Instant::now();
        for _ in 0..200 {
            let sample = self.sample_in_time()?;
            // The device's watchdog may have made the condition true.
            if last_act.elapsed() > TOO_SLOW {
                return Err(Disturbed);
            }
            if done(&sample) {
                return Ok(sample);
            }
            // The device may refuse this act.
            let _ = self.link.act(Self::VOLTAGE_MV, sample.device_time_us);
            if last_act.elapsed() > TOO_SLOW {
                return Err(Disturbed);
            }
            last_act = Instant::now();
            std::thread::sleep(PERIOD);
        }
        panic!("the condition did not hold within 200 samples");
    }

    /// Arms and drives for at least 0.1 s, until a sample shows the voltage.
    pub fn arm_and_drive(&mut self) -> Result<(), Disturbed> {
        self.link.arm().unwrap();
        let mut ticks = 0;
        let last = self.drive_until(|sample| {
            ticks += 1;
            ticks > 10 && sample.status.armed && sample.applied_mv > 0
        })?;
        let _ = self.link.act(Self::VOLTAGE_MV, last.device_time_us);
        Ok(())
    }

    /// Commands that the Qube received after a simulated time.
    pub fn commands_since(&self, time_us: u64) -> Vec<Command> {
        self.board.qube().commands.iter().filter(|it| it.deselected_us > time_us).copied().collect()
    }

    /// The time from an order that switches the motor off to the first command without the motor,
    /// us, and all commands from this command on. The motor must have been on when the order came.
    pub fn off_after_order(&self) -> Result<(u64, Vec<Command>), Disturbed> {
        let ordered_us = self.board.ordered_us();
        let mut off = self.commands_since(ordered_us.saturating_sub(BEFORE_ORDER_US));
        let last_on = off.iter().rposition(Command::motor_is_on).ok_or(Disturbed)?;
        off.drain(..=last_on);
        let first = off.first().expect("the motor goes off");
        // On a slow computer the device's watchdog may switch the motor off before the order.
        let off_after_us = first.deselected_us.checked_sub(ordered_us).ok_or(Disturbed)?;
        Ok((off_after_us, off))
    }
}

/// Runs a scenario on a fresh Uno, and repeats it while the computer is too slow.
pub fn scenario(run: impl Fn(&mut Host) -> Result<(), Disturbed>) {
    scenario_on(Chip::Atmega328p, run);
}

/// Runs a scenario like [`scenario`], on this chip. An attempt that ends with [`Disturbed`] is
/// repeated only if a processor stalled in it or the simulation lost real time; if the computer
/// kept up, the board has failed. An attempt that panics is repeated only if a processor stalled,
/// and the last attempt never.
pub fn scenario_on(chip: Chip, run: impl Fn(&mut Host) -> Result<(), Disturbed>) {
    let Some(toolchain) = toolchain() else { return };
    for attempt in 1..=ATTEMPTS {
        let outcome = Cell::new(None);
        let (ended, stood) = witnessed(&|| {
            let board = SimulatedBoard::start(toolchain, chip, Qube::new(1));
            let mut host = Host::greet(board);
            let before_us = host.board.given_up_us();
            let result = run(&mut host);
            outcome.set(Some((result, host.board.given_up_us() - before_us)));
        });
        let given_up_us = match (ended, outcome.take()) {
            (Err(panic), _) if stood < STANDS_STILL || attempt == ATTEMPTS => resume_unwind(panic),
            // A simulation that has panicked does not report how much time it lost.
            (Err(_), _) => 0,
            (Ok(()), Some((Err(Disturbed), given_up_us))) => given_up_us,
            (Ok(()), _) => return,
        };
        let stood_ms = stood.as_millis();
        assert!(
            stood >= STANDS_STILL || given_up_us > 0,
            "the board is not in time, although the computer stood still for {stood_ms} ms only \
             and the simulation lost {given_up_us} us"
        );
        // Bypasses the test harness, which hides the output of a test that passes.
        let _ = writeln!(
            std::io::stderr(),
            "attempt {attempt} of at most {ATTEMPTS} proves nothing: the computer stood still for \
             {stood_ms} ms, and the simulation lost at least {given_up_us} us"
        );
        wait_for_calm();
    }
    panic!("the computer was too slow for this test {ATTEMPTS} times");
}

/// A new link, which has neither sent nor received anything, over the same wire.
pub fn next_link(host: &mut Host) -> SerialLink<&mut Tty> {
    SerialLink::new(host.link.transport(), Arc::new(MonotonicClock))
}
