//! The machine as the operating system tells it: processor, memory, load, clock; and the peaks that `doctor`, `plan` and
//! `bench` measure. Unknown where the system tells nothing.

use serde_json::{Value, json};
use sf_ops::{Kernels, peak};
use std::fs;
use std::time::Duration;

/// What the operating system tells about the machine.
pub(crate) struct Machine {
    pub(crate) cpu: Option<String>,
    pub(crate) logical_cpus: Option<usize>,
    pub(crate) allowed_threads: usize,
    pub(crate) memory_total_bytes: Option<u64>,
    pub(crate) memory_available_bytes: Option<u64>,
    pub(crate) memory_limit_bytes: Option<u64>,
    pub(crate) governor: Option<String>,
}

/// The value after the first `key : value` line of a text like `/proc/cpuinfo`.
fn field<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    text.lines().find_map(|l| l.split_once(':').filter(|(k, _)| k.trim() == key).map(|(_, v)| v.trim()))
}

/// A `/proc/meminfo` amount, which is in KiB.
fn meminfo(text: &str, key: &str) -> Option<u64> {
    field(text, key)?.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
}

fn read(path: &str) -> Option<String> {
    fs::read_to_string(path).ok()
}

impl Machine {
    /// Asks the system.
    pub(crate) fn probe() -> Machine {
        let cpuinfo = read("/proc/cpuinfo").unwrap_or_default();
        let memory = read("/proc/meminfo").unwrap_or_default();
        let cpus = cpuinfo.lines().filter(|l| l.split(':').next().is_some_and(|k| k.trim() == "processor")).count();
        let name = ["model name", "Model", "Hardware", "CPU part"].iter().find_map(|k| field(&cpuinfo, k));
        Machine {
            cpu: name.map(str::to_string),
            logical_cpus: (cpus > 0).then_some(cpus),
            allowed_threads: std::thread::available_parallelism().map_or(1, usize::from),
            memory_total_bytes: meminfo(&memory, "MemTotal"),
            memory_available_bytes: meminfo(&memory, "MemAvailable"),
            memory_limit_bytes: read("/sys/fs/cgroup/memory.max").and_then(|t| t.trim().parse().ok()),
            governor: read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor").map(|t| t.trim().to_string()),
        }
    }

    /// Memory that this process can still get: what is free, or what its control group leaves, whichever is less.
    pub(crate) fn free_bytes(&self) -> Option<u64> {
        let used = read("/sys/fs/cgroup/memory.current").and_then(|t| t.trim().parse::<u64>().ok()).unwrap_or(0);
        let left = self.memory_limit_bytes.map(|limit| limit.saturating_sub(used));
        [self.memory_available_bytes, left].into_iter().flatten().min()
    }

    /// For reports.
    pub(crate) fn json(&self) -> Value {
        json!({
            "os": std::env::consts::OS,
            "arch": std::env::consts::ARCH,
            "cpu": self.cpu,
            "logical_cpus": self.logical_cpus,
            "allowed_threads": self.allowed_threads,
            "memory_total_bytes": self.memory_total_bytes,
            "memory_available_bytes": self.memory_available_bytes,
            "memory_limit_bytes": self.memory_limit_bytes,
            "governor": self.governor,
        })
    }
}

/// Name and kernels of one instruction set.
pub(crate) fn kernels_json(k: &Kernels) -> Value {
    let rows = k.rows().into_iter().map(|(family, name)| (family.to_string(), name.into()));
    Value::Object(std::iter::once(("isa".to_string(), k.isa.name().into())).chain(rows).collect())
}

/// Runnable tasks of the whole machine, averaged over the last minute.
pub(crate) fn load_average() -> Option<f64> {
    read("/proc/loadavg")?.split_whitespace().next()?.parse().ok()
}

/// The highest clock of any core now, MHz.
pub(crate) fn mhz() -> Option<f64> {
    let cpuinfo = read("/proc/cpuinfo")?;
    let clocks = cpuinfo.lines().filter_map(|l| l.split_once(':')).filter(|(k, _)| k.trim() == "cpu MHz");
    clocks.filter_map(|(_, v)| v.trim().parse::<f64>().ok()).max_by(f64::total_cmp)
}

/// Processor time of this process so far, all threads; in steps of 10 ms.
pub(crate) fn cpu_time() -> Option<Duration> {
    let stat = read("/proc/self/stat")?;
    // The name in parentheses may hold anything; utime and stime are the 12th and 13th field after it.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let ticks = fields.next()?.parse::<u64>().ok()? + fields.next()?.parse::<u64>().ok()?;
    // Linux reports in hundredths of a second on every architecture.
    Some(Duration::from_millis(10 * ticks))
}

/// A `/proc/self/status` amount in bytes.
fn status_bytes(key: &str) -> Option<u64> {
    meminfo(&read("/proc/self/status")?, key)
}

/// Memory that this process holds now.
pub(crate) fn rss_bytes() -> Option<u64> {
    status_bytes("VmRSS")
}

/// Most memory this process has held since its start, or since [`forget_peak_rss`].
pub(crate) fn peak_rss_bytes() -> Option<u64> {
    status_bytes("VmHWM")
}

/// Starts the peak of [`peak_rss_bytes`] again from what is held now; false where the system has no such switch.
pub(crate) fn forget_peak_rss() -> bool {
    fs::write("/proc/self/clear_refs", "5").is_ok()
}

/// Operations per second that threads reach together in registers, two per multiply-add.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Peak {
    /// f32 multiply-adds.
    pub(crate) f32: f64,
    /// int8 dot products.
    pub(crate) s8: f64,
}

impl Peak {
    /// Measures for `time` each, on all threads at once: cores share clock and power.
    pub(crate) fn measure(kernels: &Kernels, threads: usize, time: Duration) -> Peak {
        Peak {
            f32: peak::together(threads, || peak::flops_per_second(kernels, time)),
            s8: peak::together(threads, || peak::s8_ops_per_second(kernels, time)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn proc_texts_are_read() {
        let text = "processor\t: 0\nmodel name\t: Some CPU: 3 GHz\nprocessor\t: 1\n";
        assert_eq!(field(text, "model name"), Some("Some CPU: 3 GHz"));
        assert_eq!(field(text, "missing"), None);
        assert_eq!(meminfo("MemTotal:       16 kB\nMemAvailable: x kB\n", "MemTotal"), Some(16384));
        assert_eq!(meminfo("MemTotal:       16 kB\nMemAvailable: x kB\n", "MemAvailable"), None);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn this_process_is_seen() {
        let before = cpu_time().unwrap();
        let start = std::time::Instant::now();
        let mut x = 1u64;
        while cpu_time().unwrap() - before < Duration::from_millis(30) && start.elapsed() < Duration::from_secs(30) {
            x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        }
        assert!(cpu_time().unwrap() > before, "{x}");
        assert!(rss_bytes().unwrap() > 1 << 16);
        assert!(peak_rss_bytes().unwrap() >= rss_bytes().unwrap() / 2);
    }
}
