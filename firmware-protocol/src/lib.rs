//! The wire between a computer and the microcontroller at a Quanser Qube.
#![no_std]
