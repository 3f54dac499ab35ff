use std::io;
use std::sync::{Mutex, PoisonError};

use crossbeam_channel::Sender;

/// A service's whole use of the library, from loading it to closing the card.
pub(super) type Work = Box<dyn FnOnce() + Send>;

/// The one thread of this process that calls the vendor's library, once it has been started.
static THREAD: Mutex<Option<Sender<Work>>> = Mutex::new(None);

/// Gives this work to the library's thread, which does it after all earlier work; starts the thread
/// if it does not run. If earlier work panics, the work that waits behind it is lost.
///
/// The vendor does not publish whether several threads of a process may call the library one after
/// the other, even once the card is closed. A session opens its card several times, so the thread
/// outlives all of them.
pub(super) fn give(work: Work) -> io::Result<()> {
    let mut thread = THREAD.lock().unwrap_or_else(PoisonError::into_inner);
    let work = match &*thread {
        None => work,
        // The channel is closed if earlier work has panicked, which ended its thread.
        Some(to_do) => match to_do.send(work) {
            Ok(()) => return Ok(()),
            Err(unsent) => unsent.into_inner(),
        },
    };
    let (to_do, given) = crossbeam_channel::unbounded::<Work>();
    let body = move || given.iter().for_each(|work| work());
    std::thread::Builder::new().name("hil library".into()).spawn(body)?;
    let _ = to_do.send(work);
    *thread = Some(to_do);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_thread_does_all_work_and_a_new_one_does_the_work_after_a_panic() {
        let (sender, receiver) = crossbeam_channel::unbounded();
        let send_thread_id = || {
            let sender = sender.clone();
            give(Box::new(move || sender.send(std::thread::current().id()).unwrap())).unwrap();
        };
        send_thread_id();
        send_thread_id();
        let (first, second) = (receiver.recv().unwrap(), receiver.recv().unwrap());
        assert_eq!(first, second);
        assert_ne!(first, std::thread::current().id());
        give(Box::new(|| panic!("the work panics on purpose"))).unwrap();
        // Work that is given before the thread has ended is lost with the thread.
        let next = std::iter::repeat_with(|| {
            send_thread_id();
            receiver.recv_timeout(std::time::Duration::from_millis(200))
        });
        assert!(next.take(20).any(|received| received.is_ok()));
    }
}
