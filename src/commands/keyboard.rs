//! The keys of an operator at a terminal: the space bar requests a stop, and `a` acknowledges a
//! doubt. The keys of the screen work, too, if there is one.

use std::os::fd::{AsFd, OwnedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use rustix::event::{EventfdFlags, eventfd};
use rustix::io::Errno;
use rustix::stdio::stdin;
use rustix::termios::isatty;

use super::printable::print_message;
use super::screen::Progress;
use super::stop::Stop;
use super::suspension::Suspension;
use super::terminal;
use crate::control::HomingMethod;
use crate::rig::{DeviceChoice, Doubt};

/// The key Ctrl-\\, which sends no signal while the keyboard is watched. It requests a stop, as
/// somebody who presses it expects.
const CTRL_BACKSLASH: u8 = 0x1c;

/// A reader of single keys from the terminal; dropping it restores the terminal.
///
/// Ctrl-C and Ctrl-Z remain signals. In the background, and if stdin is not a terminal, the
/// keyboard reads and changes nothing.
#[derive(Debug)]
pub struct Keyboard {
    watched: Option<Watched>,
    progress: Progress,
}

/// The effect of Ctrl-Z.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CtrlZ {
    /// Suspends the program until the shell continues it.
    Suspends,
    /// Requests a stop, as the space bar does: a program that is suspended can brake no arm.
    Stops,
}

impl CtrlZ {
    /// Returns the effect in a command that drives these Qubes.
    pub fn with<'d>(devices: impl IntoIterator<Item = &'d DeviceChoice>) -> Self {
        let drives_hardware = devices.into_iter().any(DeviceChoice::is_hardware);
        if drives_hardware { Self::Stops } else { Self::Suspends }
    }
}

#[derive(Debug)]
struct Watched {
    shared: Arc<Shared>,
    keys: Receiver<u8>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    stop: Arc<AtomicBool>,
    /// True while a question waits for a key: the next key then answers it and requests no stop.
    asking: AtomicBool,
    ctrl_z: CtrlZ,
    suspension: Suspension,
    ended: AtomicBool,
    wake: OwnedFd,
    progress: Progress,
}

impl Keyboard {
    /// Watches the terminal; the space bar requests a stop. With a screen, the screen's keys work,
    /// too.
    pub fn watch(stop: &Stop, progress: &Progress, ctrl_z: CtrlZ) -> Self {
        let watched = if isatty(stdin()) { Watched::start(stop, progress, ctrl_z) } else { None };
        Self { watched, progress: progress.clone() }
    }

    /// Watches the terminal of a command that drives no Qube, if it has a screen.
    pub fn of_screen(stop: &Stop, progress: &Progress) -> Option<Self> {
        progress.has_screen().then(|| Self::watch(stop, progress, CtrlZ::Suspends))
    }

    /// Makes a keyboard without a terminal.
    #[cfg(test)]
    pub fn none() -> Self {
        Self { watched: None, progress: Progress::lines() }
    }

    /// Returns the sentence on keys that the operator needs before anything moves.
    pub fn hint(&self) -> String {
        match self.watched {
            Some(_) if !terminal::is_foreground() => format!(
                "neither the space bar nor Ctrl-C reaches this program, because it is in the \
                 background: kill -INT {} brakes the arm and keeps the state",
                std::process::id()
            ),
            Some(_) => "the space bar or Ctrl-C brakes the arm and keeps the state".to_owned(),
            None => "Ctrl-C brakes the arm and keeps the state".to_owned(),
        }
    }

    /// Asks at a terminal whether the operator has looked at the Qube; returns whether the answer
    /// is `a` or `A`. False without a terminal, in its background, or after a stop request.
    pub fn acknowledges(&self, doubt: &Doubt, homing: HomingMethod, stop: &Stop) -> bool {
        let Some(Watched { shared, keys, .. }) = &self.watched else { return false };
        if !terminal::is_foreground() {
            return false;
        }
        let middle = match homing {
            HomingMethod::Stops => "",
            HomingMethod::Hand => {
                " Put the arm into its middle: its place then counts as the middle."
            }
        };
        let question = format!(
            "{doubt}.\nLook at the Qube.{middle} Then press a: it is examined, and driven again. \
             Any other key ends the command."
        );
        print_message(&question);
        self.progress.ask(&question);
        while keys.try_recv().is_ok() {}
        shared.asking.store(true, Ordering::Relaxed);
        let key = loop {
            match keys.recv_timeout(Duration::from_millis(100)) {
                Ok(key) => break Some(key),
                Err(RecvTimeoutError::Timeout) if !stop.requested() => {}
                Err(_) => break None,
            }
        };
        shared.asking.store(false, Ordering::Relaxed);
        self.progress.answered();
        matches!(key, Some(b'a' | b'A'))
    }
}

impl Watched {
    fn start(stop: &Stop, progress: &Progress, ctrl_z: CtrlZ) -> Option<Self> {
        let wake = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK).ok()?;
        let shared = Arc::new(Shared {
            stop: Arc::clone(&stop.flag),
            asking: AtomicBool::new(false),
            ctrl_z,
            suspension: Suspension::take_over(),
            ended: AtomicBool::new(false),
            wake,
            progress: progress.clone(),
        });
        let (sender, keys) = bounded(16);
        let watched = Arc::clone(&shared);
        // The terminal is set here rather than in the thread, so that no key is lost or echoed once
        // this function has returned.
        terminal::set_single_keys();
        let spawned = std::thread::Builder::new()
            .name("keyboard".into())
            .spawn(move || read_keys(&watched, &sender));
        match spawned {
            Ok(thread) => Some(Self { shared, keys, thread: Some(thread) }),
            Err(_) => {
                terminal::restore();
                None
            }
        }
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        // The counter cannot be full, because this is its only write.
        let _ = rustix::io::write(&self.shared.wake, &1_u64.to_ne_bytes());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        terminal::restore();
    }
}

impl Shared {
    fn request_stop(&self) {
        if !self.stop.swap(true, Ordering::Relaxed) {
            print_message(&format!("stopping: {}", self.progress.stop_effect()));
        }
    }
}

fn read_keys(shared: &Shared, keys: &Sender<u8>) {
    while !shared.ended.load(Ordering::Relaxed) {
        if shared.suspension.was_asked() {
            match shared.ctrl_z {
                CtrlZ::Stops => shared.request_stop(),
                CtrlZ::Suspends => {
                    terminal::restore();
                    shared.suspension.suspend();
                }
            }
        }
        terminal::set_single_keys();
        terminal::resume_screen();
        if !terminal::wait_for_input(Some(shared.wake.as_fd())) {
            continue;
        }
        let mut buffer = [0; 16];
        let length = match terminal::is_foreground().then(|| terminal::read_input(&mut buffer)) {
            Some(Ok(length @ 1..)) => length,
            Some(Err(Errno::AGAIN | Errno::INTR)) => continue,
            // The program is in the background, a Ctrl-D came while a shell had the terminal, or
            // the terminal was closed, for which SIGHUP stops the program.
            None | Some(Ok(0) | Err(_)) => {
                std::thread::sleep(Duration::from_millis(100));
                continue;
            }
        };
        for &key in &buffer[..length] {
            if shared.asking.load(Ordering::Relaxed) {
                let _ = keys.try_send(key);
                continue;
            }
            let is_stop = match shared.progress.has_screen() {
                true => shared.progress.pressed(key),
                false => key == b' ',
            };
            if is_stop || key == CTRL_BACKSLASH {
                shared.request_stop();
            }
        }
    }
}
