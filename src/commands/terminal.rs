//! The terminal of an operator: single keys without echo while a Qube is driven, and back again.

use std::sync::{Mutex, PoisonError};

use rustix::stdio::stdin;
use rustix::termios::{
    LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetpgrp, tcsetattr,
};

/// Terminal settings before keys were read singly; `None` while they are in force.
static COOKED: Mutex<Option<Termios>> = Mutex::new(None);

/// Restores the terminal, also for exits that drop nothing.
pub fn restore() {
    let mut cooked = COOKED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(cooked) = cooked.take() {
        let _ = tcsetattr(stdin(), OptionalActions::Now, &cooked);
    }
}

/// Sets the terminal to single keys without echo. Ctrl-\\ is disabled meanwhile, because it would end the
/// program without restoring the terminal.
pub fn set_single_keys() {
    let mut cooked = COOKED.lock().unwrap_or_else(PoisonError::into_inner);
    if cooked.is_some() || !is_foreground() {
        return;
    }
    let Ok(before) = tcgetattr(stdin()) else { return };
    let mut single = before.clone();
    single.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
    single.special_codes[SpecialCodeIndex::VMIN] = 1;
    single.special_codes[SpecialCodeIndex::VTIME] = 0;
    single.special_codes[SpecialCodeIndex::VQUIT] = 0;
    if tcsetattr(stdin(), OptionalActions::Now, &single).is_ok() {
        *cooked = Some(before);
    }
}

/// Whether the terminal belongs to this process group; reading another's terminal would stop the program.
pub fn is_foreground() -> bool {
    tcgetpgrp(stdin()).is_ok_and(|group| group == rustix::process::getpgrp())
}
