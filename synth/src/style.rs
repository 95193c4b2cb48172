//! [`Style`]: the distribution that streets are drawn from.

/// What a clip is drawn from; the defaults are the shipped distribution.
#[derive(Clone, Debug, PartialEq)]
pub struct Style {
    /// Probability of dusk.
    pub dim: f64,
    /// Probability of direct sun; the rest is overcast.
    pub sunny: f64,
    /// Probability that the camera car turns at a crossing.
    pub turning: f64,
    /// Probability of a crossing where it does not turn.
    pub crossing: f64,
    /// Spread of the road's curvature, 1/m (clipped at 0.018; a quarter of it where there is a crossing).
    pub curvature: f64,
    /// Probability that the camera car stands.
    pub standing: f64,
    /// Probability that it crawls at 0.5 to 4 m/s.
    pub slow: f64,
    /// Its speed otherwise, m/s, uniform.
    pub speed: (f64, f64),
    /// Spread of its acceleration, m/s^2.
    pub acceleration: f64,
    /// Horizontal field of view, degrees, uniform.
    pub hfov: (f64, f64),
    /// Camera height, metres, uniform.
    pub camera_height: (f64, f64),
    /// Spread of the mounting pitch, degrees.
    pub pitch: f64,
    /// Spread of the mounting yaw, degrees.
    pub yaw: f64,
    /// Probability of a slow pan to the side.
    pub glance: f64,
    /// Probability that there is traffic at all.
    pub traffic: f64,
    /// Moving vehicles where there is traffic, smallest and largest number.
    pub vehicles: (usize, usize),
    /// Share of buses and lorries among them.
    pub heavy: f64,
    /// Share of parking places taken.
    pub parked: f64,
    /// Mean number of people walking within sight.
    pub people: f64,
    /// Probability of cyclists.
    pub cyclists: f64,
    /// Probability that a frontage is built up rather than open.
    pub built: f64,
    /// Probability of a row of trees on a side.
    pub trees: f64,
}

impl Default for Style {
    fn default() -> Style {
        Style {
            dim: 0.15,
            sunny: 0.5,
            turning: 0.3,
            crossing: 0.35,
            curvature: 0.005,
            standing: 0.12,
            slow: 0.18,
            speed: (4.0, 15.0),
            acceleration: 0.8,
            hfov: (50.0, 66.0),
            camera_height: (1.4, 1.9),
            pitch: 1.2,
            yaw: 4.0,
            glance: 0.2,
            traffic: 0.92,
            vehicles: (2, 6),
            heavy: 0.14,
            parked: 0.6,
            people: 5.0,
            cyclists: 0.25,
            built: 0.76,
            trees: 0.6,
        }
    }
}
