use super::*;
use crate::clock::VirtualClock;
use crate::device::InProcessWire;
use crate::device::emulator::{EmulatorFault, EmulatorSettings};

fn failures(fault: Option<EmulatorFault>) -> Vec<&'static str> {
    let clock = VirtualClock::default();
    let settings = EmulatorSettings { fault, ..EmulatorSettings::default() };
    let mut wire = InProcessWire::new(settings, clock.clone());
    let mut speaker = Speaker::new(&mut wire, &clock);
    CHECKS
        .iter()
        .filter_map(|check| match check.run(&mut speaker) {
            Ok(()) => None,
            Err(deviation) => {
                println!("{}: {deviation}", check.name);
                Some(check.name)
            }
        })
        .collect()
}

#[test]
fn the_emulator_conforms_in_virtual_time() {
    assert_eq!(failures(None), Vec::<&str>::new());
}

#[test]
fn a_device_that_does_not_conform_is_found() {
    assert_eq!(failures(Some(EmulatorFault::Silent { after_s: 0.0 })).len(), CHECKS.len());
    let absent = failures(Some(EmulatorFault::QubeAbsent { after_s: 0.0 }));
    assert!(absent.contains(&"hello") && absent.contains(&"arm"), "{absent:?}");
    let version = failures(Some(EmulatorFault::WrongVersion));
    assert!(version.contains(&"hello") && version.contains(&"version-mismatch"), "{version:?}");
    assert!(!failures(Some(EmulatorFault::Garble { every: 7 })).is_empty());
}

#[test]
fn names_are_unique() {
    let mut names: Vec<_> = CHECKS.iter().map(|check| check.name).collect();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), CHECKS.len());
}
