//! Controls the operator's terminal: sets it to single keys without echo, shows the screen of a
//! long command on it, and restores it afterwards.

use std::fs::File;
use std::io::{self, Write};
use std::os::fd::{BorrowedFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError, TryLockError};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, open};
use rustix::io::fcntl_dupfd_cloexec;
use rustix::stdio::{stderr, stdin};
use rustix::termios::{
    InputModes, LocalModes, OptionalActions, QueueSelector, SpecialCodeIndex, Termios, tcflush,
    tcgetattr, tcgetpgrp, tcsetattr,
};

/// The terminal's settings before single keys were read; `None` while these settings are in force.
static SETTINGS_BEFORE: Mutex<Option<Termios>> = Mutex::new(None);

/// The terminal of the screen; `None` without a screen.
static SCREEN: Mutex<Option<ScreenTerminal>> = Mutex::new(None);

/// True once [`leave`] was called: the terminal then stays as the program found it.
static LEFT: AtomicBool = AtomicBool::new(false);

/// True if the next frame must be drawn whole.
static REDRAW: AtomicBool = AtomicBool::new(false);

/// Switches to the alternate screen, hides the cursor and clears the screen.
const ENTER: &[u8] = b"\x1b[?1049h\x1b[?25l\x1b[2J";

/// Resets the style, shows the cursor and leaves the alternate screen, so that the terminal's
/// earlier contents are shown again.
const LEAVE: &[u8] = b"\x1b[0m\x1b[?25h\x1b[?1049l";

/// The controlling terminal, opened once more so that reading it never waits; `None` without one.
static TYPED: OnceLock<Option<OwnedFd>> = OnceLock::new();

/// Longest wait for input, after which the caller checks for other events.
const POLL_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };

struct ScreenTerminal {
    /// A duplicate of stderr as it was before its capture: the terminal.
    terminal: File,
    /// True while the terminal shows the screen; false while the program is suspended.
    is_shown: bool,
}

impl ScreenTerminal {
    fn show(&mut self) {
        if !self.is_shown && !LEFT.load(Ordering::Relaxed) && self.terminal.write_all(ENTER).is_ok()
        {
            self.is_shown = true;
            REDRAW.store(true, Ordering::Relaxed);
        }
    }

    fn hide(&mut self) {
        if self.is_shown {
            // A terminal that is gone needs no restoring.
            let _ = self.terminal.write_all(LEAVE);
            self.is_shown = false;
        }
    }
}

/// Shows an empty screen on the terminal behind stderr.
///
/// # Errors
/// Stderr cannot be duplicated.
pub fn enter_screen() -> io::Result<()> {
    let terminal = File::from(fcntl_dupfd_cloexec(stderr(), 3)?);
    let mut screen = ScreenTerminal { terminal, is_shown: false };
    screen.show();
    *SCREEN.lock().unwrap_or_else(PoisonError::into_inner) = Some(screen);
    Ok(())
}

/// Ends the screen: the terminal's earlier contents are shown again.
pub fn leave_screen() {
    if let Some(mut screen) = SCREEN.lock().unwrap_or_else(PoisonError::into_inner).take() {
        screen.hide();
    }
}

/// Shows the screen again after a suspension has hidden it; does nothing while the program is in
/// the background.
pub fn resume_screen() {
    if let Ok(mut screen) = SCREEN.try_lock()
        && let Some(screen) = screen.as_mut().filter(|screen| !screen.is_shown)
        && is_foreground()
    {
        screen.show();
    }
}

/// Writes a frame to the screen; does nothing while the screen is not shown.
pub fn write_screen(frame: &[u8]) {
    let mut screen = SCREEN.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(screen) = screen.as_mut().filter(|screen| screen.is_shown) {
        let _ = screen.terminal.write_all(frame);
    }
}

/// Returns whether the next frame must be drawn whole, and resets this request.
pub fn take_redraw() -> bool {
    REDRAW.swap(false, Ordering::Relaxed)
}

/// Hides the screen; [`resume_screen`] shows it again. Gives up after 0.2 s if another thread is
/// writing a frame to a halted terminal.
fn hide_screen() {
    for _ in 0..20 {
        let mut screen = match SCREEN.try_lock() {
            Ok(screen) => screen,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => {
                std::thread::sleep(Duration::from_millis(10));
                continue;
            }
        };
        if let Some(screen) = screen.as_mut() {
            screen.hide();
        }
        return;
    }
}

/// Hides the screen and restores the terminal's settings. In the background it changes no settings,
/// because they belong to the program in the foreground, and the system would stop a program that
/// changes them.
pub fn restore() {
    hide_screen();
    let mut saved = SETTINGS_BEFORE.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(before) = saved.take()
        && is_foreground()
    {
        let _ = tcsetattr(stdin(), OptionalActions::Now, &before);
    }
}

/// Restores the terminal for good: [`set_single_keys`] and [`resume_screen`] then change nothing.
/// It is for an exit that runs no destructors, where other threads would set the terminal to single
/// keys again.
pub fn leave() {
    LEFT.store(true, Ordering::Relaxed);
    restore();
}

/// Sets the terminal to single keys without echo; does nothing in the background, without a
/// terminal, or after [`leave`]. Until [`restore`], Ctrl-\\ is a key like others, because its signal
/// would end the program without braking the arm and restoring the terminal; so is Ctrl-S, which
/// would hold up the screen, and with it the program's end.
pub fn set_single_keys() {
    let mut saved = SETTINGS_BEFORE.lock().unwrap_or_else(PoisonError::into_inner);
    if LEFT.load(Ordering::Relaxed) || !is_foreground() {
        return;
    }
    let Ok(now) = tcgetattr(stdin()) else { return };
    // While the program was suspended, a shell may have set its own modes.
    if saved.is_some() && !now.local_modes.contains(LocalModes::ICANON) {
        return;
    }
    let mut single = now.clone();
    single.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
    single.input_modes.remove(InputModes::IXON);
    single.special_codes[SpecialCodeIndex::VMIN] = 1;
    single.special_codes[SpecialCodeIndex::VTIME] = 0;
    single.special_codes[SpecialCodeIndex::VQUIT] = 0;
    if tcsetattr(stdin(), OptionalActions::Now, &single).is_ok() {
        saved.get_or_insert(now);
    }
}

/// Waits until stdin has input or has ended, until `wake` can be read, or for 0.1 s; returns
/// whether stdin has input or has ended.
pub fn wait_for_input(wake: Option<BorrowedFd<'_>>) -> bool {
    let input = stdin();
    let wake = wake.unwrap_or(input);
    let mut ready =
        [PollFd::new(&input, PollFlags::IN), PollFd::from_borrowed_fd(wake, PollFlags::IN)];
    poll(&mut ready, Some(&POLL_INTERVAL)).is_ok() && !ready[0].revents().is_empty()
}

/// Reads the input that [`wait_for_input`] has found.
///
/// Ctrl-C discards the keys that were typed before it, so that a key may be gone by the time it is
/// read. A read of stdin would then wait for the next one, and the program could not end.
///
/// # Errors
/// `AGAIN`: the keys are gone. Any other: the input has failed.
pub fn read_input(buffer: &mut [u8]) -> rustix::io::Result<usize> {
    let open_again = || {
        let flags = OFlags::RDONLY | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
        open("/dev/tty", flags, Mode::empty()).ok()
    };
    match is_foreground().then(|| TYPED.get_or_init(open_again).as_ref()).flatten() {
        Some(typed) => rustix::io::read(typed, buffer),
        None => rustix::io::read(stdin(), buffer),
    }
}

/// Discards the keys that were typed and not read. Input from another source than a terminal stays,
/// and so do the keys at a terminal in whose background the program runs: the system would stop a
/// program that discards them.
pub fn discard_typed_keys() {
    if is_foreground() {
        let _ = tcflush(stdin(), QueueSelector::IFlush);
    }
}

/// Returns whether this process group is in the terminal's foreground. The system stops a program
/// in the background that reads the terminal.
pub fn is_foreground() -> bool {
    tcgetpgrp(stdin()).is_ok_and(|group| group == rustix::process::getpgrp())
}
