"""Closed forms of the bouncing ball: its height under penalty contact, and its flight under instantaneous bounces."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gradscape.envs.engines.balls.rigid import Ball


@dataclass(frozen=True)
class End:
    """Height [m] and vertical speed [m/s] at the end, and how often the ball has left the ground."""

    y: float
    v: float
    bounces: int


def damping_ratio(ball: Ball) -> float:
    """Return kd / (2 sqrt(ke m)), below 1 for a contact that swings."""
    return ball.kd / (2 * math.sqrt(ball.ke * ball.mass))


def restitution(ball: Ball) -> float:
    """Return the speed after a contact by that before it, where gravity does nothing in between.

    Approaching is a quarter of a damped oscillation, departing a quarter of an undamped one.
    """
    zeta = damping_ratio(ball)
    root = math.sqrt(1 - zeta**2)
    return math.exp(-zeta / root * math.atan2(root, zeta))


def penalty_flight(ball: Ball, y: float, v: float, time: float) -> End:
    """Follow a ball above the ground through ballistic flights and contacts that are arcs of oscillations."""
    bounces = 0
    while True:
        lasting = _fall_time(ball, y, v)
        if lasting >= time:
            return End(y + v * time - ball.gravity * time**2 / 2, v - ball.gravity * time, bounces)
        time, y, v = time - lasting, ball.radius, v - ball.gravity * lasting
        for contact in (_Approach(ball, v), _Departure(ball, v)):  # both are set by the speed of touching
            if contact.lasting >= time:
                u, v = contact.at(time)
                return End(ball.radius + _rest(ball) + u, v, bounces)
            time -= contact.lasting
            _, v = contact.at(contact.lasting)
        bounces += 1


def instant_flight(ball: Ball, y: float, v: float, time: float) -> End:
    """Follow a ball that leaves the ground at once, with the effective restitution."""
    bounces, e = 0, restitution(ball)
    while True:
        lasting = _fall_time(ball, y, v)
        if lasting >= time:
            return End(y + v * time - ball.gravity * time**2 / 2, v - ball.gravity * time, bounces)
        time, y, v = time - lasting, ball.radius, -e * (v - ball.gravity * lasting)
        bounces += 1


def _fall_time(ball: Ball, y: float, v: float) -> float:
    return (v + math.sqrt(v**2 + 2 * ball.gravity * (y - ball.radius))) / ball.gravity


def _rest(ball: Ball) -> float:
    """Return the height above touching at which the ball would rest [m], below 0."""
    return -ball.mass * ball.gravity / ball.ke


class _Approach:
    """u'' + 2 g u' + w^2 u = 0 from the moment of touching to the lowest point; u is counted from the rest height."""

    def __init__(self, ball: Ball, v: float) -> None:
        self.decay = ball.kd / (2 * ball.mass)
        self.frequency = math.sqrt(ball.ke / ball.mass - self.decay**2)
        self.cosine = -_rest(ball)
        self.sine = (v + self.decay * self.cosine) / self.frequency
        # v(t) = 0 where tan(w t) = (w sine - g cosine) / (w cosine + g sine)
        up = self.frequency * self.sine - self.decay * self.cosine
        self.lasting = (math.atan2(-up, -self.frequency * self.cosine - self.decay * self.sine)) / self.frequency

    def at(self, t: float) -> tuple[float, float]:
        c, s = math.cos(self.frequency * t), math.sin(self.frequency * t)
        fade = math.exp(-self.decay * t)
        u = fade * (self.cosine * c + self.sine * s)
        return u, fade * self.frequency * (self.sine * c - self.cosine * s) - self.decay * u


class _Departure:
    """u'' + w^2 u = 0 from the lowest point to the moment of leaving."""

    def __init__(self, ball: Ball, v: float) -> None:
        approach = _Approach(ball, v)
        self.lowest, _ = approach.at(approach.lasting)
        self.frequency = math.sqrt(ball.ke / ball.mass)
        self.lasting = math.acos(-_rest(ball) / self.lowest) / self.frequency

    def at(self, t: float) -> tuple[float, float]:
        c, s = math.cos(self.frequency * t), math.sin(self.frequency * t)
        return self.lowest * c, -self.lowest * self.frequency * s
