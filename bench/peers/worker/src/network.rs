//! The network on one clip.

use crate::Work;
use sf_formats::blob::LoadMode;
use std::path::Path;
use std::sync::Arc;
use streetforward::{ClipShape, Input, Model, Options, Session};

struct Network {
    session: Session,
    shape: ClipShape,
    images: Vec<u8>,
    times: Vec<f64>,
}

pub(crate) fn open(args: &[String]) -> Result<Box<dyn Work>, String> {
    let [model, frames, width, height, threads, clip, times] = args else {
        return Err("network MODEL FRAMES WIDTH HEIGHT THREADS CLIP TIMES".into());
    };
    let number = |text: &String| text.parse::<usize>().map_err(|_| format!("{text}: not a number"));
    let shape = ClipShape { frames: number(frames)?, height: number(height)?, width: number(width)? };
    let images = std::fs::read(clip).map_err(|e| format!("{clip}: {e}"))?;
    let times =
        times.split(',').map(|t| t.parse::<f64>().map_err(|_| format!("time {t}"))).collect::<Result<_, _>>()?;
    let model = Arc::new(Model::open(Path::new(model), LoadMode::Map).map_err(|e| e.to_string())?);
    let options = Options { threads: number(threads)?, ..Options::default() };
    let session = Session::new(model, shape, options).map_err(|e| e.to_string())?;
    Ok(Box::new(Network { session, shape, images, times }))
}

impl Work for Network {
    fn run(&mut self) -> Result<(), String> {
        let input = Input { shape: self.shape, images: &self.images, times: &self.times, k: None };
        self.session.run(&input).map(|_| ()).map_err(|e| e.to_string())
    }

    fn save(&self, folder: &str) -> Result<(), String> {
        let out = self.session.output();
        let poses: Vec<f32> = out.poses.iter().flat_map(|p| p.to_rows()).flatten().map(|v| v as f32).collect();
        let files: [(&str, &[f32]); 10] = [
            ("pose", &poses),
            ("depth", &out.depth),
            ("mean", out.mean.as_flattened()),
            ("scale", out.scale.as_flattened()),
            ("quat", out.quat.as_flattened()),
            ("opacity", &out.opacity),
            ("colour", out.colour.as_flattened()),
            ("v_fwd", out.v_fwd.as_flattened()),
            ("v_bwd", out.v_bwd.as_flattened()),
            ("dynamic", &out.dynamic),
        ];
        for (name, values) in files {
            let path = Path::new(folder).join(format!("{name}.f32"));
            let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            std::fs::write(&path, bytes).map_err(|e| format!("{}: {e}", path.display()))?;
        }
        Ok(())
    }
}
