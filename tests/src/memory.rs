//! Memory of a process; Linux only.

/// Resident memory of a process, in units of 1,048,576 bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Memory {
    /// Now (`VmRSS`).
    pub resident_mb: f64,
    /// At most since the start of the process (`VmHWM`).
    pub peak_mb: f64,
}

impl Memory {
    /// The memory of a process; `None` on other systems, or after the process has ended.
    pub fn of(process: u32) -> Option<Self> {
        let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
        Self::parse(&status)
    }

    fn parse(status: &str) -> Option<Self> {
        let mb = |name: &str| {
            let line = status.lines().find_map(|l| l.strip_prefix(name))?;
            let kilobytes: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
            Some(kilobytes / 1024.0)
        };
        Some(Self {
            resident_mb: mb("VmRSS:")?,
            peak_mb: mb("VmHWM:")?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::Memory;

    #[test]
    fn resident_and_peak_memory_are_read_in_megabytes() {
        let status = "Name:\tx\nVmHWM:\t    4096 kB\nVmRSS:\t    2048 kB\n";
        let memory = Memory::parse(status).unwrap();
        assert_eq!((memory.resident_mb, memory.peak_mb), (2.0, 4.0));
        assert_eq!(Memory::parse("Name:\tx\n"), None);
    }
}
