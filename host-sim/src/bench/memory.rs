//! How much memory this process took.

/// Most physical memory that the process had at once, bytes; `None` where the system does not tell.
pub fn peak_bytes() -> Option<u64> {
    high_water_mark(&std::fs::read_to_string("/proc/self/status").ok()?)
}

/// `VmHWM` of Linux's `/proc/PID/status` (proc(5)), whose kB are 1024 bytes.
fn high_water_mark(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim_end().parse::<u64>().ok()?.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mark_is_read_in_bytes() {
        let status = "Name:\thost-sim\nVmPeak:\t   99 kB\nVmHWM:\t    1536 kB\nVmRSS:\t  1 kB\n";
        assert_eq!(high_water_mark(status), Some(1536 * 1024));
        for other in ["", "VmHWM:\n", "VmHWM:\t12 MB\n", "VmHWM:\tmuch kB\n"] {
            assert_eq!(high_water_mark(other), None, "{other:?}");
        }
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn memory_that_was_touched_is_counted() {
        let touched = std::hint::black_box(vec![1_u8; 8 << 20]);
        assert!(peak_bytes().unwrap() > touched.len() as u64);
    }
}
