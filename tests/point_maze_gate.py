import sys; sys.path.insert(0, str(__import__("pathlib").Path(__file__).parent))
import jax, jax.numpy as jnp, time, dataclasses, numpy as np
from functools import partial
import taic_jax as taic
from taic_jax.config.learners import SACConfig
from taic_jax.envs import TimeLimit
from point_maze import PointMaze
from probes import Repeat
from taic_jax.analysis.evaluate import evaluate
kw=dict(a.split("=") for a in sys.argv[1:])
uniform=kw.pop("uniform","1")=="1"; seeds=int(kw.pop("seeds","1")); decisions=int(kw.pop("decisions","50000"))
base=dict(num_envs=16,rollout_length=200,update_every=20,warmup=20000,capacity=60000,batch_size=128,hidden_sizes=(128,128),bound=1.0,gamma=0.998,relabel=4,learning_rate=1e-3)
for k,v in kw.items():
    base[k]= type(base.get(k,0.0))(eval(v)) if not isinstance(base.get(k),tuple) else eval(v)
c=SACConfig(**base)
env=TimeLimit(PointMaze(1.0,uniform),1000)
ex=Repeat(20,2)
ticks=decisions*20
t=time.time()
f=jax.jit(jax.vmap(lambda k: taic.train(c,env,ex,k,ticks=ticks)))
agent,m=f(jax.random.split(jax.random.key(0),seeds)); jax.block_until_ready(m)
print(base, "uniform",uniform,"seconds",time.time()-t)
for k in ("return","temperature","entropy","value","critic_loss","mean/success"):
    print(k,[round(float(x),2) for x in np.asarray(m[k])[0][::max(1,len(m[k][0])//12)]])
ev=jax.jit(jax.vmap(lambda a,k: evaluate(env.evaluated,a,k,5,0.0)))(agent,jax.random.split(jax.random.key(1),seeds))
print({k:np.asarray(v) for k,v in ev.items() if "final" in k or k=="return"})
