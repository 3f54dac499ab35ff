//! Tests that a small file needs little memory, however much content it declares: the measure is
//! the largest number of bytes in use while the file is read.

use std::alloc::{GlobalAlloc, Layout, System};
use std::io::Write;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use crc::{CRC_32_ISO_HDLC, Crc};
use qube_hil::recording::{Completeness, parse};

/// Limit of the memory for a file of a few megabytes, bytes: one block at a time, and the ticks.
const LARGEST_BYTES: usize = 32 << 20;

static IN_USE: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);
/// Lock that lets one test run at a time, because the counters include every thread's allocations.
static TURN: Mutex<()> = Mutex::new(());

/// The system's allocator, which counts the bytes in use.
struct Counting;

// SAFETY: every call is handed on unchanged to the system's allocator, which keeps the contract.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let now = IN_USE.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        PEAK.fetch_max(now, Ordering::Relaxed);
        // SAFETY: as this function's caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        IN_USE.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as this function's caller promises.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    let mut bytes = vec![opcode];
    bytes.extend((body.len() as u64).to_le_bytes());
    bytes.extend(body);
    bytes
}

fn block(content: &[u8]) -> Vec<u8> {
    let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
    encoder.write_all(content).unwrap();
    let packed = encoder.finish().0;
    let mut chunk = vec![0; 16];
    chunk.extend((content.len() as u64).to_le_bytes());
    chunk.extend(Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(content).to_le_bytes());
    chunk.extend(3_u32.to_le_bytes());
    chunk.extend(b"lz4");
    chunk.extend((packed.len() as u64).to_le_bytes());
    chunk.extend(packed);
    record(6, &chunk)
}

fn text(bytes: &[u8]) -> Vec<u8> {
    [&(bytes.len() as u32).to_le_bytes(), bytes].concat()
}

/// Waits for the test's turn, which begins before the test builds its file.
fn turn() -> MutexGuard<'static, ()> {
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Checks that the beginning of a real recording with `more` behind it is read with little memory,
/// during the test's turn.
#[track_caller]
fn is_read_with_little_memory(_turn: &MutexGuard<'_, ()>, more: &[u8]) {
    let bytes = [include_bytes!("../fuzz/begun.mcap").as_slice(), more].concat();
    assert!(bytes.len() < 8 << 20, "{} bytes are not a small file", bytes.len());
    let before = IN_USE.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    let recording = parse(&bytes).unwrap();
    let used = PEAK.load(Ordering::Relaxed) - before;
    assert!(matches!(recording.completeness, Completeness::CutOff { .. }));
    assert!(used < LARGEST_BYTES, "{used} bytes for a file of {}", bytes.len());
}

#[test]
fn channel_names_that_unpack_to_a_gigabyte_need_little_memory() {
    let turn = turn();
    // 250 channels of 4 MB each, packed to some 16 kB each.
    let name = text(&vec![b'x'; 4_000_000]);
    let blocks = (0..250_u16).flat_map(|id| {
        let ids = [id.to_le_bytes(), 0_u16.to_le_bytes()].concat();
        block(&record(4, &[ids, name.clone()].concat()))
    });
    is_read_with_little_memory(&turn, &blocks.collect::<Vec<u8>>());
}

#[test]
fn many_unknown_records_need_little_memory() {
    let turn = turn();
    is_read_with_little_memory(&turn, &record(0x55, &[]).repeat(700_000));
}

#[test]
fn large_and_unknown_metadata_need_little_memory() {
    let turn = turn();
    let entries: Vec<u8> = (0..100_000_u32)
        .flat_map(|number| [text(&number.to_le_bytes()), text(&[])].concat())
        .collect();
    let large = record(12, &[text(b"rollout"), text(&entries)].concat());
    let many = (0..4000_u32).flat_map(|number| {
        record(12, &[text(format!("name {number}").as_bytes()), text(&entries[..600])].concat())
    });
    is_read_with_little_memory(&turn, &many.chain(large).collect::<Vec<u8>>());
}
