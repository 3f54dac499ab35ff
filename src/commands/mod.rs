//! One file per subcommand: arguments, a call into the library, printing.
//!
//! May import everything; nobody imports it.
