//! The thread pool of the network: fixed threads, numbered tasks, no allocation after creation.
//!
//! A region is `pool.run(tasks, f)`: `f(task, worker)` is called once for every task. Every worker begins with its own share
//! of the tasks (the first worker with the first ones) and then helps the others, so which worker runs a task is open; what a task
//! computes must therefore not depend on it. The caller is worker 0. Shares keep rows at home: the operations of a network cut the
//! same rows into tasks one after the other, and what a core wrote lies in its own second-level cache.
//!
//! One word holds the state of the pool: an epoch, an *open* bit and the number of workers inside.
//! A worker joins an open region that it has not seen yet; the caller closes the region when no task
//! is left and waits only for the workers that did join. A worker that the system never scheduled
//! therefore costs nothing, which is what matters when there are more threads than cores. Waiting
//! spins for some ten microseconds (the usual gap between two regions of a network) and then parks.
//!
//! Nothing else in this crate makes threads.

use std::any::Any;
use std::cell::{Cell, UnsafeCell};
use std::marker::PhantomData;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::SeqCst};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{JoinHandle, Thread};

/// Spins before parking: about 20 ns each on current x86 cores, so some 40 microseconds.
const SPINS: u32 = 2000;
/// The region accepts workers.
const OPEN: u64 = 1 << 31;
/// Low bits: workers inside the region.
const INSIDE: u64 = OPEN - 1;
/// The epoch is counted in the high half.
const EPOCH: u64 = 1 << 32;

type Task<'a> = dyn Fn(usize, usize) + Sync + 'a;

thread_local! {
    /// Set while this thread runs a task, to refuse nested regions.
    static IN_TASK: Cell<bool> = const { Cell::new(false) };
}

/// First task of worker `w`'s share.
fn share_start(tasks: usize, workers: usize, w: usize) -> usize {
    (tasks as u128 * w as u128 / workers as u128) as usize
}

/// A mutex whose data stay valid whatever panicked while it was held.
fn lock<T>(m: &Mutex<T>) -> MutexGuard<'_, T> {
    m.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A counter on cache lines of its own; they are fetched in pairs.
#[repr(align(128))]
struct Next(AtomicUsize);

struct Shared {
    /// Epoch, open bit, workers inside.
    state: AtomicU64,
    stop: AtomicBool,
    /// The open region's closure and task count. Written only while the region is closed and empty.
    job: UnsafeCell<(*const Task<'static>, usize)>,
    /// The next task of every worker's share.
    next: Box<[Next]>,
    /// `parked[w]`: worker w + 1 sleeps or is about to.
    parked: Box<[AtomicBool]>,
    /// The caller sleeps or is about to.
    caller_parked: AtomicBool,
    caller: Mutex<Option<Thread>>,
    panic: Mutex<Option<Box<dyn Any + Send>>>,
}

// SAFETY: `job` is written by the one caller that holds `Pool::gate`, and only while no worker is inside;
// workers read it only between joining and leaving an open region. The closure behind it is Sync.
#[allow(unsafe_code)]
unsafe impl Sync for Shared {}
// SAFETY: the raw pointer is only used as described above; everything else is Send.
#[allow(unsafe_code)]
unsafe impl Send for Shared {}

impl Shared {
    /// Takes tasks until none is left. A panic is kept for the caller and ends the region early.
    fn work(&self, f: &Task<'_>, tasks: usize, worker: usize) {
        IN_TASK.set(true);
        let result = catch_unwind(AssertUnwindSafe(|| {
            let shares = self.next.len();
            for share in (worker..shares).chain(0..worker) {
                let end = share_start(tasks, shares, share + 1);
                loop {
                    let task = self.next[share].0.fetch_add(1, SeqCst);
                    if task >= end {
                        break;
                    }
                    f(task, worker);
                }
            }
        }));
        IN_TASK.set(false);
        if let Err(payload) = result {
            self.next.iter().for_each(|next| next.0.store(tasks, SeqCst));
            lock(&self.panic).get_or_insert(payload);
        }
    }

    fn worker_loop(&self, worker: usize) {
        let mut seen = 0u64;
        loop {
            let mut spins = 0u32;
            // Join the next open region.
            loop {
                if self.stop.load(SeqCst) {
                    return;
                }
                let s = self.state.load(SeqCst);
                if s & OPEN != 0 && s / EPOCH != seen {
                    if self.state.compare_exchange(s, s + 1, SeqCst, SeqCst).is_ok() {
                        seen = s / EPOCH;
                        break;
                    }
                } else if spins < SPINS {
                    spins += 1;
                    std::hint::spin_loop();
                } else {
                    // Announce, look again, sleep: the caller publishes first and looks at the flag second.
                    let flag = &self.parked[worker - 1];
                    flag.store(true, SeqCst);
                    let s = self.state.load(SeqCst);
                    if !(s & OPEN != 0 && s / EPOCH != seen || self.stop.load(SeqCst)) {
                        std::thread::park();
                    }
                    flag.store(false, SeqCst);
                    spins = 0;
                }
            }
            // SAFETY: this worker is counted as inside, so the caller neither rewrites the job nor returns
            // from `run` (which keeps the closure borrowed) before the decrement below.
            #[allow(unsafe_code)]
            let (f, tasks) = unsafe {
                let (f, tasks) = *self.job.get();
                (&*f, tasks)
            };
            self.work(f, tasks, worker);
            let before = self.state.fetch_sub(1, SeqCst);
            if before & INSIDE == 1
                && self.caller_parked.load(SeqCst)
                && let Some(t) = lock(&self.caller).as_ref()
            {
                t.unpark();
            }
        }
    }
}

/// A fixed set of threads that runs numbered tasks.
///
/// # Example
/// ```
/// let pool = sf_ops::par::Pool::new(2)?;
/// let mut squares = [0u64; 100];
/// pool.chunks(&mut squares, 10, &|i, chunk, _worker| {
///     for (j, x) in chunk.iter_mut().enumerate() {
///         *x = ((10 * i + j) as u64).pow(2);
///     }
/// });
/// assert_eq!(squares[99], 99 * 99);
/// # Ok::<(), std::io::Error>(())
/// ```
pub struct Pool {
    shared: Arc<Shared>,
    workers: Vec<JoinHandle<()>>,
    /// One region at a time.
    gate: Mutex<()>,
    /// Working memory of the kernels, one per worker, grown on first use and kept.
    scratch: Box<[Mutex<Vec<f32>>]>,
}

impl Pool {
    /// A pool of `threads` workers, the caller included; 0 counts as 1.
    ///
    /// # Errors
    /// When the system refuses a thread; threads made so far are ended.
    pub fn new(threads: usize) -> std::io::Result<Pool> {
        let threads = threads.max(1);
        let shared = Arc::new(Shared {
            state: AtomicU64::new(0),
            stop: AtomicBool::new(false),
            job: UnsafeCell::new((&|_: usize, _: usize| {}, 0)),
            next: (0..threads).map(|_| Next(AtomicUsize::new(0))).collect(),
            parked: (1..threads).map(|_| AtomicBool::new(false)).collect(),
            caller_parked: AtomicBool::new(false),
            caller: Mutex::new(None),
            panic: Mutex::new(None),
        });
        let mut pool = Pool {
            shared,
            workers: Vec::with_capacity(threads - 1),
            gate: Mutex::new(()),
            scratch: (0..threads).map(|_| Mutex::new(Vec::new())).collect(),
        };
        for worker in 1..threads {
            let shared = Arc::clone(&pool.shared);
            let handle = std::thread::Builder::new().name(format!("sf-worker-{worker}")).spawn(move || {
                crate::cpu::set_default_float_mode();
                shared.worker_loop(worker);
            })?;
            pool.workers.push(handle);
        }
        Ok(pool)
    }

    /// Workers, the caller included.
    pub fn threads(&self) -> usize {
        self.workers.len() + 1
    }

    /// Calls `f(task, worker)` once for every task in `0..tasks`, `worker < threads()`, and returns when all are done.
    ///
    /// No allocation. A region with one task, or in a pool of one, runs on the calling thread. Calls from
    /// several threads take turns.
    ///
    /// # Panics
    /// With the first panic of `f`, after every worker has left; and when called from inside a task.
    pub fn run(&self, tasks: usize, f: &(dyn Fn(usize, usize) + Sync)) {
        assert!(!IN_TASK.get(), "Pool::run called from inside a task");
        if tasks == 0 {
            return;
        }
        let _turn = lock(&self.gate);
        let s = &*self.shared;
        let shares = s.next.len();
        s.next.iter().enumerate().for_each(|(w, next)| next.0.store(share_start(tasks, shares, w), SeqCst));
        if tasks == 1 || self.workers.is_empty() {
            s.work(f, tasks, 0);
        } else {
            // SAFETY: only the lifetime changes. The region is closed and empty before this function returns,
            // also when `f` panics (`work` catches), so no worker uses the closure after its borrow ends;
            // and no worker is inside now, because the previous region was left the same way.
            #[allow(unsafe_code)]
            unsafe {
                *s.job.get() = (std::mem::transmute::<*const Task<'_>, *const Task<'static>>(f), tasks);
            }
            let epoch = (s.state.load(SeqCst) / EPOCH).wrapping_add(1) & (u64::MAX / EPOCH);
            s.state.store((epoch * EPOCH) | OPEN, SeqCst);
            for (flag, worker) in s.parked.iter().zip(&self.workers) {
                if flag.load(SeqCst) {
                    worker.thread().unpark();
                }
            }
            s.work(f, tasks, 0);
            s.state.fetch_and(!OPEN, SeqCst);
            self.wait_until_empty();
        }
        let payload = lock(&s.panic).take();
        if let Some(payload) = payload {
            resume_unwind(payload);
        }
    }

    fn wait_until_empty(&self) {
        let s = &*self.shared;
        let busy = || s.state.load(SeqCst) & INSIDE != 0;
        for _ in 0..SPINS {
            if !busy() {
                return;
            }
            std::hint::spin_loop();
        }
        *lock(&s.caller) = Some(std::thread::current());
        s.caller_parked.store(true, SeqCst);
        while busy() {
            std::thread::park();
        }
        s.caller_parked.store(false, SeqCst);
    }

    /// Cuts `data` into pieces of `chunk` values (the last may be shorter) and calls `f(index, piece, worker)`
    /// for each.
    pub fn chunks<T: Send>(&self, data: &mut [T], chunk: usize, f: &(dyn Fn(usize, &mut [T], usize) + Sync)) {
        assert!(chunk > 0, "chunks of 0 values");
        let len = data.len();
        let shared = SharedMut::new(data);
        self.run(len.div_ceil(chunk), &|task, worker| {
            let start = task * chunk;
            // SAFETY: task indices are distinct, so the ranges are disjoint.
            #[allow(unsafe_code)]
            let piece = unsafe { shared.slice(start..(start + chunk).min(len)) };
            f(task, piece, worker);
        });
    }

    /// Gives every worker at least `len` values of working memory. It is kept, so a second run of the same work
    /// allocates nothing, whichever worker takes which task.
    pub fn reserve_scratch(&self, len: usize) {
        for memory in &self.scratch {
            let mut memory = lock(memory);
            if memory.len() < len {
                memory.resize(len, 0.0);
            }
        }
    }

    /// Calls `f` with `len` values of the worker's own working memory, contents unspecified.
    pub fn with_scratch<R>(&self, worker: usize, len: usize, f: impl FnOnce(&mut [f32]) -> R) -> R {
        let mut memory = lock(&self.scratch[worker]);
        if memory.len() < len {
            memory.resize(len, 0.0);
        }
        f(&mut memory[..len])
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.shared.stop.store(true, SeqCst);
        for w in self.workers.drain(..) {
            w.thread().unpark();
            // A worker never panics: tasks are caught.
            let _ = w.join();
        }
    }
}

impl std::fmt::Debug for Pool {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pool").field("threads", &self.threads()).finish()
    }
}

/// One buffer handed to many tasks as disjoint pieces.
#[derive(Debug)]
pub struct SharedMut<'a, T> {
    data: *mut T,
    len: usize,
    owner: PhantomData<&'a mut [T]>,
}

// SAFETY: it is a mutable slice whose pieces go to different threads under the contract of `slice`.
#[allow(unsafe_code)]
unsafe impl<T: Send> Sync for SharedMut<'_, T> {}
// SAFETY: as above.
#[allow(unsafe_code)]
unsafe impl<T: Send> Send for SharedMut<'_, T> {}

impl<'a, T> SharedMut<'a, T> {
    /// Over the whole of `data`.
    pub fn new(data: &'a mut [T]) -> Self {
        Self { data: data.as_mut_ptr(), len: data.len(), owner: PhantomData }
    }

    /// Address of value `at`, also outside: for hints only.
    #[inline]
    pub(crate) fn at(&self, at: usize) -> *const T {
        self.data.wrapping_add(at)
    }

    /// The values in `range`.
    ///
    /// # Panics
    /// When the range leaves the buffer.
    ///
    /// # Safety
    /// No two pieces that are alive at the same time may overlap.
    #[allow(unsafe_code, clippy::mut_from_ref)]
    #[inline]
    pub unsafe fn slice(&self, range: Range<usize>) -> &'a mut [T] {
        assert!(range.start <= range.end && range.end <= self.len, "{range:?} of {} values", self.len);
        // SAFETY: inside the buffer (checked); exclusive by the caller's promise and the borrow in `owner`.
        unsafe { std::slice::from_raw_parts_mut(self.data.add(range.start), range.end - range.start) }
    }

    /// `N` pieces of `len` values, `stride` apart, the first at `at`: checked once, so that a loop over them is free of checks.
    ///
    /// # Panics
    /// When a piece leaves the buffer or they overlap.
    ///
    /// # Safety
    /// As of [`SharedMut::slice`].
    #[allow(unsafe_code, clippy::mut_from_ref)]
    #[inline(always)]
    pub(crate) unsafe fn lines<const N: usize>(&self, at: usize, stride: usize, len: usize) -> [&'a mut [T]; N] {
        let end = stride.checked_mul(N - 1).and_then(|v| v.checked_add(at)).and_then(|v| v.checked_add(len));
        assert!(stride >= len && end.is_some_and(|end| end <= self.len), "{N} pieces from {at} of {} values", self.len);
        // SAFETY: inside the buffer (checked); exclusive by the caller's promise and the borrow in `owner`.
        std::array::from_fn(|i| unsafe { std::slice::from_raw_parts_mut(self.data.add(at + i * stride), len) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicU32;

    #[test]
    fn every_task_runs_once() {
        for threads in [1, 2, 3, 7] {
            let pool = Pool::new(threads).unwrap();
            for tasks in [0, 1, 2, 5, 64, 1000] {
                let hits: Vec<AtomicU32> = (0..tasks).map(|_| AtomicU32::new(0)).collect();
                pool.run(tasks, &|t, w| {
                    assert!(w < threads);
                    hits[t].fetch_add(1, SeqCst);
                });
                assert!(hits.iter().all(|h| h.load(SeqCst) == 1), "{threads} threads, {tasks} tasks");
            }
        }
    }

    #[test]
    fn many_short_regions_with_more_threads_than_cores() {
        let pool = Pool::new(9).unwrap();
        let total = AtomicUsize::new(0);
        for _ in 0..3000 {
            pool.run(4, &|t, _| {
                total.fetch_add(t, SeqCst);
            });
        }
        assert_eq!(total.load(SeqCst), 3000 * 6);
    }

    #[test]
    fn wakes_after_parking() {
        let pool = Pool::new(2).unwrap();
        for _ in 0..5 {
            std::thread::sleep(std::time::Duration::from_millis(3));
            // Two tasks that wait for each other: both workers must be awake.
            let met = AtomicUsize::new(0);
            pool.run(2, &|_, _| {
                met.fetch_add(1, SeqCst);
                while met.load(SeqCst) < 2 {
                    std::thread::yield_now();
                }
            });
        }
    }

    #[test]
    fn callers_take_turns() {
        let pool = Pool::new(2).unwrap();
        let total = AtomicUsize::new(0);
        std::thread::scope(|s| {
            for _ in 0..3 {
                s.spawn(|| {
                    for _ in 0..200 {
                        pool.run(3, &|_, _| {
                            total.fetch_add(1, SeqCst);
                        });
                    }
                });
            }
        });
        assert_eq!(total.load(SeqCst), 3 * 200 * 3);
    }

    #[test]
    fn a_panic_reaches_the_caller_and_the_pool_lives_on() {
        let pool = Pool::new(3).unwrap();
        for bad in [0, 7] {
            let caught = catch_unwind(AssertUnwindSafe(|| {
                pool.run(8, &|t, _| assert!(t != bad, "task {t}"));
            }));
            let message = *caught.unwrap_err().downcast::<String>().unwrap();
            assert_eq!(message, format!("task {bad}"));
            let count = AtomicUsize::new(0);
            pool.run(8, &|_, _| {
                count.fetch_add(1, SeqCst);
            });
            assert_eq!(count.load(SeqCst), 8);
        }
    }

    #[test]
    fn nested_regions_are_refused() {
        let pool = Pool::new(2).unwrap();
        let caught = catch_unwind(AssertUnwindSafe(|| pool.run(2, &|_, _| pool.run(2, &|_, _| {}))));
        assert!(caught.is_err());
    }

    #[test]
    fn chunks_cover_the_buffer() {
        let pool = Pool::new(2).unwrap();
        let mut data = vec![0u32; 103];
        pool.chunks(&mut data, 10, &|i, piece, _| piece.fill(i as u32 + 1));
        for (i, &v) in data.iter().enumerate() {
            assert_eq!(v as usize, i / 10 + 1);
        }
    }
}
