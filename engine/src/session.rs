//! [`Session`]: one model, one clip shape, its memory and its threads.
//!
//! Everything is sized and allocated on creation; a run fills the memory again and again. The order of
//! the network is in `forward.rs`.

use crate::arena::{Arena, carve, carved_len};
use crate::block::Net;
use crate::forward::{Areas, Forward, Memory};
use crate::input::Input;
use crate::model::Model;
use crate::output::Output;
use crate::plan::{ClipShape, DEFAULT_MAX_BYTES, Plan};
use crate::probe::{Probe, STAGES, TapFn};
use crate::tables::Tables;
use sf_formats::{Error, Result};
use sf_ops::cpu::{Ctx, DefaultFloatMode, Isa, Kernels};
use sf_ops::par::Pool;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Most threads of a session.
pub const MAX_THREADS: usize = 64;

/// How a session runs.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Threads; 0 is what the system allows this process.
    pub threads: usize,
    /// Upper limit on the instructions used; `None` is the best of this CPU (and of the environment).
    pub isa: Option<Isa>,
    /// Memory the session may take.
    pub max_bytes: u64,
}

impl Default for Options {
    fn default() -> Self {
        Options { threads: 0, isa: None, max_bytes: DEFAULT_MAX_BYTES }
    }
}

/// Time a stage took in the last run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageTime {
    /// Stage.
    pub name: &'static str,
    /// Wall time.
    pub time: Duration,
}

/// A model ready to run clips of one shape.
pub struct Session {
    model: Arc<Model>,
    pool: Pool,
    kernels: &'static Kernels,
    plan: Plan,
    tables: Tables,
    arena: Arena,
    memory: Memory,
    /// Whether `memory.output` is a whole result.
    complete: bool,
    cancel: Arc<AtomicBool>,
    times: [Duration; STAGES.len()],
}

impl Session {
    /// Plans and allocates for one clip shape.
    pub fn new(model: Arc<Model>, shape: ClipShape, options: Options) -> Result<Session> {
        let _mode = DefaultFloatMode::enter();
        if options.threads > MAX_THREADS {
            return Err(Error::usage(format!("{} threads: at most {MAX_THREADS}", options.threads)));
        }
        let threads = match options.threads {
            0 => std::thread::available_parallelism().map_or(1, |n| n.get()).min(MAX_THREADS),
            n => n,
        };
        let kernels = match options.isa {
            Some(isa) => Kernels::capped(isa),
            None => Kernels::from_env(),
        }
        .map_err(|why| Error::unsupported("instruction set", why))?;
        let plan = Plan::new(&model, shape, threads, options.max_bytes)?;
        let pool = Pool::new(threads)
            .map_err(|e| Error::resource("threads", format!("the system refused {threads} threads: {e}")))?;
        meet(&pool);
        let arena = Arena::new(carved_len(plan.areas))?;
        let memory = Memory::new(&model, shape)?;
        let tables = Tables::new(&model, &plan.dims);
        let cancel = Arc::new(AtomicBool::new(false));
        Ok(Session {
            model,
            pool,
            kernels,
            plan,
            tables,
            arena,
            memory,
            complete: false,
            cancel,
            times: Default::default(),
        })
    }

    /// Sizes and memory.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// The model.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// Threads in use.
    pub fn threads(&self) -> usize {
        self.pool.threads()
    }

    /// Kernels in use.
    pub fn kernels(&self) -> &'static Kernels {
        self.kernels
    }

    /// A flag that ends a run between two layers when set, from any thread; the run then fails with
    /// status 8. It stays set until cleared.
    pub fn cancel_flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.cancel)
    }

    /// Wall time of every stage in the last run.
    pub fn stage_times(&self) -> impl Iterator<Item = StageTime> {
        STAGES.iter().zip(&self.times).map(|(&name, &time)| StageTime { name, time })
    }

    /// Runs the network on a clip of the session's shape.
    pub fn run(&mut self, input: &Input) -> Result<&Output> {
        self.run_watched(input, None, None)
    }

    /// [`Session::run`] with a deadline and a function that sees every stage.
    ///
    /// After `deadline` the run stops at the next layer with status 8. A result is whole or absent.
    pub fn run_watched(&mut self, input: &Input, deadline: Option<Instant>, taps: Option<TapFn>) -> Result<&Output> {
        if input.shape != self.plan.shape() {
            let (have, want) = (input.shape, self.plan.shape());
            if have.frames > want.frames {
                let why = format!(
                    "{} frames, the session is planned for {}: run windows of the clip",
                    have.frames, want.frames
                );
                return Err(Error::resource("clip", why));
            }
            return Err(Error::input("clip", format!("{have:?} in a session made for {want:?}")));
        }
        input.check()?;
        self.model.blob().unchanged()?;
        let _mode = DefaultFloatMode::enter();
        let [pairs, motion, work] = carve(self.arena.all(), self.plan.areas);
        let net = Net { ctx: Ctx { pool: &self.pool, kernels: self.kernels }, model: &self.model };
        let forward = Forward { net, config: self.model.config(), plan: &self.plan, tables: &self.tables, input };
        let mut probe = Probe::new(taps, &self.cancel, deadline, &mut self.times);
        self.complete = false;
        forward.run(Areas { pairs, motion, work }, &mut self.memory, &mut probe)?;
        self.complete = true;
        Ok(&self.memory.output)
    }

    /// Result of the last run.
    ///
    /// # Panics
    /// When there was none, or it failed: a result is whole or absent.
    pub fn output(&self) -> &Output {
        assert!(self.complete, "no complete result: the session has not run, or its last run failed");
        &self.memory.output
    }
}

/// Returns when every thread of the pool has run: the system starts threads late on a busy machine, and a
/// thread's start allocates, which belongs here and not into a run.
fn meet(pool: &Pool) {
    let here = AtomicUsize::new(0);
    pool.run(pool.threads(), &|_, _| {
        here.fetch_add(1, Ordering::SeqCst);
        // Nobody takes a second task before all have one.
        while here.load(Ordering::SeqCst) < pool.threads() {
            std::thread::yield_now();
        }
    });
}
