//! [`Session`]: one model, one clip shape, its memory and its threads.
//!
//! Everything is sized and allocated on creation; a run fills the memory again and again. The order of
//! the network is in `forward.rs`.

use crate::arena::{Arena, carve, carved_len, filled};
use crate::dims::ClipShape;
use crate::forward::{self, Areas, Forward, Memory};
use crate::input::Input;
use crate::model::Model;
use crate::net::{Net, Rows, Seen};
use crate::output::Output;
use crate::plan::{DEFAULT_MAX_BYTES, Plan};
use crate::probe::{Probe, STAGES, TapFn, Watch};
use crate::tables::Tables;
use sf_formats::{Error, Intrinsics, Result};
use sf_ops::cpu::{Ctx, DefaultFloatMode, Isa, Kernels};
use sf_ops::par::Pool;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
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
    rows: Rows,
    memory: Memory,
    /// Whether `memory.output` is a whole result.
    complete: bool,
    window: Option<Window>,
    cancel: Arc<AtomicBool>,
    layers: Arc<AtomicU32>,
    times: [Duration; STAGES.len()],
}

/// The last frames of a running camera and their encoder tokens.
struct Window {
    /// `[frames, height, width, 3]`.
    images: Vec<u8>,
    times: Vec<f64>,
    /// `[frames, tokens, dim]`.
    tokens: Vec<f32>,
    /// Tokens of the frame being encoded.
    newest: Vec<f32>,
}

impl Window {
    /// Room for a full window and the frame that pushes the oldest out.
    fn new(shape: ClipShape, per_frame: usize) -> Result<Window> {
        let mut window = Window {
            images: filled("window", shape.frames * shape.height * shape.width * 3, 0)?,
            times: filled("window", shape.frames, 0.0)?,
            tokens: filled("window", shape.frames * per_frame, 0.0)?,
            newest: filled("window", per_frame, 0.0)?,
        };
        window.images.clear();
        window.times.clear();
        window.tokens.clear();
        Ok(window)
    }

    /// Takes the encoded frame in; the oldest leaves a full window.
    fn push(&mut self, image: &[u8], time: f64, frames: usize, per_frame: usize) {
        if self.times.len() == frames {
            self.images.drain(..image.len());
            self.times.remove(0);
            self.tokens.drain(..per_frame);
        }
        self.images.extend_from_slice(image);
        self.times.push(time);
        self.tokens.extend_from_slice(&self.newest);
    }
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
        // First, so that what tables are made from is gone before the large areas come.
        let tables = Tables::new(&model, &plan.dims);
        pool.reserve_scratch(plan.thread_values);
        let arena = Arena::new(carved_len(plan.areas))?;
        let rows = Rows::new(plan.rows)?;
        let memory = Memory::new(&model, shape)?;
        let cancel = Arc::new(AtomicBool::new(false));
        Ok(Session {
            model,
            pool,
            kernels,
            plan,
            tables,
            arena,
            rows,
            memory,
            complete: false,
            window: None,
            cancel,
            layers: Arc::new(AtomicU32::new(0)),
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

    /// Transformer blocks that the run in progress has finished, of [`Plan::layers`]; readable from any thread.
    pub fn layers_done(&self) -> Arc<AtomicU32> {
        Arc::clone(&self.layers)
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
        self.run_seen(input, deadline, taps, None)
    }

    /// [`Session::run`] with a function that sees the input rows of every linear layer whose inputs exist as floats, all of
    /// them in an f32 or f16 model, and windows of every convolution (`[ky][kx][in]`, up to 1,024 of an image), with the name of
    /// the weight: what the rounding of weights is calibrated with. Transposed convolutions and the patch embedding are not shown.
    pub fn run_observed(&mut self, input: &Input, seen: &dyn Fn(&str, &[f32])) -> Result<&Output> {
        let names = self.model.names();
        self.run_seen(input, None, None, Some(&|tensor: usize, row: &[f32]| seen(&names[tensor], row)))
    }

    fn run_seen(
        &mut self,
        input: &Input,
        deadline: Option<Instant>,
        taps: Option<TapFn>,
        seen: Option<Seen>,
    ) -> Result<&Output> {
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
        self.times = Default::default();
        self.layers.store(0, Ordering::Relaxed);
        let due = 0..input.shape.frames;
        self.forward(input, (None, due), (deadline, seen), taps)?;
        Ok(&self.memory.output)
    }

    fn forward(
        &mut self,
        input: &Input,
        (encoded, due): (Option<&[f32]>, Range<usize>),
        (deadline, seen): (Option<Instant>, Option<Seen>),
        taps: Option<TapFn>,
    ) -> Result<()> {
        let [pairs, guide, motion, work] = carve(self.arena.all(), self.plan.areas);
        let net =
            Net { ctx: Ctx { pool: &self.pool, kernels: self.kernels }, model: &self.model, rows: &self.rows, seen };
        let forward = Forward { net, config: self.model.config(), plan: &self.plan, tables: &self.tables, input, due };
        let watch = Watch { cancel: &self.cancel, layers: &self.layers, deadline };
        let mut probe = Probe::new(taps, watch, net.ctx, &mut self.times);
        self.complete = false;
        forward.run(Areas { pairs, guide, motion, work }, encoded, &mut self.memory, &mut probe)?;
        self.complete = true;
        Ok(())
    }

    /// Appends a frame to the session's window and runs the network on the last frames, as many as the
    /// session is planned for; `None` until there are enough.
    ///
    /// Frames are encoded once and their tokens kept (after the first frame layer of alternating attention where the network's
    /// tokens do not carry the time), so a step costs one frame of that instead of all; the result has the same bits as [`Session::run`] on the same frames. The window (frames and their tokens)
    /// is allocated by the first call, beside the plan's memory. `image` is `[height, width, 3]` at
    /// the network's size; `time` must be later than the last frame's. A frame that is refused or
    /// not encoded leaves the window as it was; when a later stage fails, the frame stays in it.
    pub fn push(&mut self, image: &[u8], time: f64, k: Option<Intrinsics>) -> Result<Option<&Output>> {
        self.push_due(image, time, k, 0..self.plan.shape().frames)
    }

    /// [`Session::push`] for who wants results of the newest frame alone: its pose, intrinsics, depth, Gaussians, velocity and
    /// dynamic probability have the bits of the whole window's, those of the other frames are not computed
    /// ([`Output::due`]).
    ///
    /// The heads then run on one frame, and every causal layer on the frames that the newest one's motion still depends on.
    /// Where one camera is fitted to the rays of all frames (`camera.k = fit_shared`) and `k` is `None`, depth is still computed for
    /// all of them.
    pub fn push_newest(&mut self, image: &[u8], time: f64, k: Option<Intrinsics>) -> Result<Option<&Output>> {
        let n = self.plan.shape().frames;
        self.push_due(image, time, k, n - 1..n)
    }

    fn push_due(
        &mut self,
        image: &[u8],
        time: f64,
        k: Option<Intrinsics>,
        due: Range<usize>,
    ) -> Result<Option<&Output>> {
        let shape = self.plan.shape();
        let one = ClipShape { frames: 1, ..shape };
        Input { shape: one, images: image, times: &[time], k }.check()?;
        if let Some(last) = self.window.as_ref().and_then(|w| w.times.last())
            && time <= *last
        {
            return Err(Error::input("frame", format!("time {time} is not after the last frame's {last}")));
        }
        self.model.blob().unchanged()?;
        let _mode = DefaultFloatMode::enter();
        self.times = Default::default();
        self.layers.store(0, Ordering::Relaxed);
        let per_frame = self.plan.frame_values;
        let mut window = match self.window.take() {
            Some(window) => window,
            None => Window::new(shape, per_frame)?,
        };
        let pushed = self.encode(image, &mut window);
        let result = pushed.and_then(|()| {
            window.push(image, time, shape.frames, per_frame);
            if window.times.len() < shape.frames {
                return Ok(false);
            }
            let input = Input { shape, images: &window.images, times: &window.times, k };
            self.forward(&input, (Some(&window.tokens), due), (None, None), None).map(|()| true)
        });
        self.window = Some(window);
        Ok(result?.then_some(&self.memory.output))
    }

    /// Forgets the frames of [`Session::push`]: the next one starts a new clip.
    pub fn restart(&mut self) {
        if let Some(window) = &mut self.window {
            window.images.clear();
            window.tokens.clear();
            window.times.clear();
        }
    }

    fn encode(&mut self, image: &[u8], window: &mut Window) -> Result<()> {
        let [_, _, _, work] = carve(self.arena.all(), self.plan.areas);
        let net = Net {
            ctx: Ctx { pool: &self.pool, kernels: self.kernels },
            model: &self.model,
            rows: &self.rows,
            seen: None,
        };
        let watch = Watch { cancel: &self.cancel, layers: &self.layers, deadline: None };
        let mut probe = Probe::new(None, watch, net.ctx, &mut self.times);
        forward::encode_frame(net, &self.plan, &self.tables, image, (work, &mut window.newest), &mut probe)
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
