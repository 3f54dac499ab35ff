/// Requests that the processor load a value into its cache. It changes no value, and does nothing
/// on architectures without such an instruction.
#[inline(always)]
pub fn prefetch<T>(wanted: &T) {
    // SAFETY: a prefetch of any address neither reads a value nor faults, and SSE is part of
    // x86-64.
    #[cfg(target_arch = "x86_64")]
    unsafe {
        use core::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T0>(core::ptr::from_ref(wanted).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = wanted;
}
