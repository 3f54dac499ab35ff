//! Tests how soon the firmware passes an act on to the Qube, and that it answers requests in spite
//! of a flood of them.

use std::time::Duration;

use firmware_protocol::scaling::{motor_counts, motor_word};
use firmware_protocol::{Decoder, Reply, Request};
use qube_hil::clock::{Clock, MonotonicClock};
use qube_hil::device::{Device, Transport};

use crate::host::{Disturbed, scenario};

const ACTS: i16 = 40;

/// Time of 17 bytes at 1 MHz, with an interrupt after each of them, us.
const FRAME_US: u64 = 17 * 11;

/// Longest time from the chip's start to the start of the firmware's clock, us: at its first start
/// the firmware writes its serial number into the EEPROM.
const BOOT_US: u64 = 60_000;

/// Largest time between the firmware's reading of its clock and the fall of chip select, us.
const CLOCK_US: u64 = 4;

/// Tests that an act starts a frame at once, or directly after the current one. Waiting for the
/// sampling timer would add up to 2 ms.
#[test]
fn the_firmware_passes_an_act_on_at_once() {
    scenario(|host| {
        host.link.arm().unwrap();
        let (mut acts, mut samples_us) = (Vec::new(), Vec::new());
        let mut before = host.sample_in_time()?;
        for act in 0..ACTS {
            // Each act has another motor word; no voltage lasts long enough to matter.
            let voltage_mv = 50 * (act - ACTS / 2);
            let _ = host.link.act(voltage_mv, before.device_time_us);
            std::thread::sleep(Duration::from_micros(7_000 + 137 * act as u64));
            let after = host.sample_in_time()?;
            if !after.status.armed {
                return Err(Disturbed);
            }
            let accepted_us =
                before.device_time_us + u64::from(after.sample_to_act_us.ok_or(Disturbed)?);
            acts.push((accepted_us, motor_word(motor_counts(voltage_mv))));
            samples_us.push(after.device_time_us);
            before = after;
        }
        let qube = host.board.qube();
        // Each sample comes from an existing frame and is timed at the fall of chip select.
        let is_of_a_frame = |time_us: u64| {
            let next = qube.commands.partition_point(|it| it.selected_us < time_us);
            qube.commands.get(next).is_some_and(|it| it.selected_us <= time_us + CLOCK_US)
        };
        let clock_begins_us = (0..BOOT_US)
            .find(|begins_us| {
                samples_us.iter().all(|sample_us| is_of_a_frame(begins_us + sample_us))
            })
            .expect("the device's clock begins within the boot time");
        let mut delays_us: Vec<u64> = acts
            .iter()
            .map(|&(accepted_us, word)| {
                let through = qube.commands.iter().find(|it| {
                    it.deselected_us > clock_begins_us + accepted_us && it.motor_word == word
                });
                through.unwrap().deselected_us - clock_begins_us - accepted_us
            })
            .collect();
        drop(qube);
        delays_us.sort_unstable();
        println!("act to Qube: {delays_us:?} us");
        assert!(delays_us[delays_us.len() / 2] < 2 * FRAME_US, "{delays_us:?}");
        assert!(delays_us[delays_us.len() - 1] < 4 * FRAME_US, "{delays_us:?}");
        Ok(())
    });
}

#[test]
fn the_firmware_survives_a_flood_of_requests() {
    scenario(|host| {
        host.link.arm().unwrap();
        for sequence in 0..400 {
            // Requests of seven bytes with answers of 32: no buffer can hold all of them.
            let sample = Request::Sample.encode(sequence);
            let _ = host.link.transport().write(sample.as_bytes());
        }
        host.board.wait_us(200_000);
        // No request of the flood fed the watchdog, and the next hello is answered.
        let commands = host.board.qube().commands.clone();
        assert_eq!(commands.last().unwrap().motor_word, 0);
        host.link.hello().unwrap();
        host.arm_and_drive()
    });
}

/// Tests that bytes which arrive while the ring of received bytes is full cost none of the first
/// requests, as many as the ring holds: 127 bytes, 18 requests of seven bytes. The ring is full
/// after about nine answers.
#[test]
fn the_firmware_answers_as_many_requests_as_its_ring_holds_although_later_bytes_are_lost() {
    const REQUESTS: u16 = 60;
    const RING_HOLDS: u16 = 18;
    scenario(|host| {
        let requests: Vec<u8> = (0..REQUESTS)
            .flat_map(|sequence| Request::Sample.encode(sequence).as_bytes().to_vec())
            .collect();
        let port = host.link.transport();
        port.write(&requests).map_err(|_| Disturbed)?;
        let (mut decoder, mut answered, mut buffer) = (Decoder::new(), Vec::new(), [0; 256]);
        loop {
            let length = port.read(&mut buffer, MonotonicClock.now_ns() + 200_000_000).unwrap();
            if length == 0 {
                break;
            }
            for frame in buffer[..length].iter().filter_map(|&byte| decoder.push(byte)) {
                let frame = frame.unwrap();
                assert!(matches!(Reply::parse(&frame), Ok(Reply::Sample(_))));
                answered.push(frame.sequence);
            }
        }
        assert!(answered.len() < usize::from(REQUESTS), "no request was lost");
        assert!(answered.starts_with(&(0..RING_HOLDS).collect::<Vec<_>>()), "{answered:?}");
        Ok(())
    });
}
