//! The command line of qube-hil; everything it does lives in the library.

fn main() {}
